"""The program ``rsvib`` within the process of the tests."""

from rsvib_torch.commands.main import run_command


def rsvib(*arguments):
    """Exit code of the program with these arguments."""
    return run_command([str(argument) for argument in arguments])
