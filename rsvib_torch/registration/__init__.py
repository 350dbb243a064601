"""Offsets of row bands between frames."""
