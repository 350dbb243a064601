"""Verdict on a restoration, without knowledge of the true scene."""
