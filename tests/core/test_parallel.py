import threading

import pytest
import torch

from rsvib_torch.core.parallel import MadeOnce, in_parallel

CPU = torch.device("cpu")


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_items_are_worked_on_side_by_side(two_threads):
    both = threading.Barrier(2, timeout=20)  # two calls at once, or it breaks

    def work(item):
        both.wait()
        return item, torch.get_num_threads(), torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    assert in_parallel(work, range(4), CPU) == [(item, 1, False, False) for item in range(4)]
    with torch.inference_mode():
        assert in_parallel(work, range(2), CPU) == [(item, 1, False, True) for item in range(2)]
    assert torch.get_num_threads() == 2
    started = []
    later = threading.Thread(target=lambda: started.append(torch.get_num_threads()))
    later.start()
    later.join()
    assert started == [2]


def test_one_thread_is_a_loop():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        assert in_parallel(lambda _: threading.current_thread(), range(2), CPU) == [threading.main_thread()] * 2
    finally:
        torch.set_num_threads(before)
    assert (
        in_parallel(lambda _: threading.current_thread(), range(2), torch.device("meta"))
        == [threading.main_thread()] * 2
    )


def test_the_caller_takes_part(two_threads):
    both = threading.Barrier(2, timeout=20)

    def work(_):
        both.wait()
        return threading.current_thread()

    assert threading.main_thread() in in_parallel(work, range(2), CPU)


def test_errors_come_out_and_nothing_else_begins(two_threads):
    both, begun = threading.Barrier(2, timeout=20), []

    def fail(item):
        begun.append(item)
        both.wait()
        raise ValueError(f"no {item}")

    with pytest.raises(ValueError, match="no 0"):
        in_parallel(fail, range(9), CPU)
    assert sorted(begun) == [0, 1]
    assert torch.get_num_threads() == 2


def test_threads_share_what_one_of_them_makes(two_threads):
    lock, making, made = threading.Lock(), threading.Event(), []
    others_turn = threading.Event()

    def make():
        making.set()
        assert others_turn.wait(timeout=20)
        made.append(threading.current_thread())
        return len(made)

    thing, another = MadeOnce(make, lock), MadeOnce(lambda: "another", lock)

    def work(item):
        if item == 0:
            thing.begin()
        else:
            assert making.wait(timeout=20)
            thing.begin()  # comes back at once: the other is at it
            another.begin()
            assert not another._made
            assert not made
            others_turn.set()
        return thing.get()

    assert in_parallel(work, range(2), CPU) == [1, 1]
    assert len(made) == 1
    assert another.get() == "another"
    assert not lock.locked()


def test_what_could_not_be_made_is_tried_again():
    def make():
        tries.append(1)
        if len(tries) < 3:
            raise ValueError("not yet")
        return "made"

    tries, lock = [], threading.Lock()
    thing = MadeOnce(make, lock)
    for attempt in (thing.begin, thing.get):
        with pytest.raises(ValueError, match="not yet"):
            attempt()
        assert not lock.locked()
    assert thing.get() == thing.get() == "made"
    assert len(tries) == 3
