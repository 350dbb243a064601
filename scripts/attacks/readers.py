"""Randomly damaged files of recorded motion and of gyroscopes: they are read, or a one-line error is raised."""

from functools import partial

from attacks import mutated

trials = partial(mutated.trials, run_every=0, names=("motion.csv", "rates.csv", "clip.gcsv", "clip.mp4"))
