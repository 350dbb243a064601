"""Slanted-edge MTF (ISO 12233, e-SFR)."""

from rsvib_torch.evaluation.mtf.curve import MtfCurve, slanted_edge_mtf

__all__ = ["MtfCurve", "slanted_edge_mtf"]
