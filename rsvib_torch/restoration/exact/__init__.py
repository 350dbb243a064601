"""Exact restoration: all rows of all frames are solved together, frequency by frequency."""
