"""Stacks of frames in files."""
