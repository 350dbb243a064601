"""Options of a section of the benchmark for tests."""

import argparse


def defaults(section, **chosen):
    """Options with their defaults and the ``QUICK`` values."""
    usual = {"size": 256, "runs": 1, "device": ["cpu"], "quick": True}
    usual |= {name: default for name, (default, *_) in section.OPTIONS.items()}
    return argparse.Namespace(**usual | section.QUICK | chosen)
