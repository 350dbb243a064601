"""Slanted-edge MTF (ISO 12233, e-SFR)."""

from rsvib_torch.evaluation.slanted_edge.curve import MtfCurve
from rsvib_torch.evaluation.slanted_edge.finder import SlantedEdge, find_slanted_edges
from rsvib_torch.evaluation.slanted_edge.measure import slanted_edge_mtf

__all__ = ["MtfCurve", "SlantedEdge", "find_slanted_edges", "slanted_edge_mtf"]
