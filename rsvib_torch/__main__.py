"""``python -m rsvib_torch``: the ``rsvib`` program of this interpreter."""

from rsvib_torch.commands.main import main

if __name__ == "__main__":
    main()
