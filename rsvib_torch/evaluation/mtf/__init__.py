"""Slanted-edge MTF (ISO 12233, e-SFR)."""

from rsvib_torch.evaluation.mtf.finder import SlantedEdge, find_slanted_edges
from rsvib_torch.evaluation.mtf.measure import slanted_edge_mtf
from rsvib_torch.evaluation.mtf.mtf_curve import MtfCurve

__all__ = ["MtfCurve", "SlantedEdge", "find_slanted_edges", "slanted_edge_mtf"]
