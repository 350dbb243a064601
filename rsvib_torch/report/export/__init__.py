"""Motions in the file formats of other programs: angular rates, sampling maps, and image support data."""
