"""The program ``rsvib`` within the process of the tests."""

from rsvib_torch.commands.main import run_command


def rsvib(*arguments):
    """Exit code of the program with these arguments."""
    return run_command([str(argument) for argument in arguments])


def refused(capsys, *arguments):
    """What the program prints if it refuses these arguments: one line about the error, and nothing else."""
    capsys.readouterr()
    assert rsvib(*arguments) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1)
    assert shown.err.startswith("rsvib: error: ")
    return shown.err
