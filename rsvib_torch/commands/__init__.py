"""The ``rsvib`` program: commands, arguments, progress and terminal output."""
