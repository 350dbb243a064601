"""Slanted-edge MTF (ISO 12233, e-SFR)."""

from rsvib_torch.evaluation.mtf.curve import MtfCurve, slanted_edge_mtf
from rsvib_torch.evaluation.mtf.finder import SlantedEdge, find_slanted_edges

__all__ = ["MtfCurve", "SlantedEdge", "find_slanted_edges", "slanted_edge_mtf"]
