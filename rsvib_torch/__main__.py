"""``python -m rsvib_torch``, and the entry point of the program ``rsvib``."""

import sys


def main() -> None:
    """Run the program; Ctrl-C while it is imported is one line as well."""
    try:
        from rsvib_torch.commands.main import main as run  # noqa: PLC0415

        run()
    except KeyboardInterrupt:
        print("rsvib: error: stopped", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
