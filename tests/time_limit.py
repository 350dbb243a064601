"""A time limit for code that must not hang."""

import signal
from contextlib import contextmanager


@contextmanager
def at_most(seconds):
    """Raise ``TimeoutError`` in the main thread after ``seconds``."""

    def stop(*_):
        raise TimeoutError(f"took more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
