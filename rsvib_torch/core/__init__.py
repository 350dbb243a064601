"""Numerical building blocks that do not depend on cameras: transforms, splines, banded systems, checks."""
