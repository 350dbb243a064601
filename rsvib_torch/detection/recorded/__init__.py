"""Motions recorded by another instrument: clock alignment and check against the frames."""
