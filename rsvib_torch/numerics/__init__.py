"""Numerical building blocks without cameras and files: transforms, splines, banded systems, tables of fits."""
