from .bound import cramer_rao_bound
from .mtf import MtfCurve, SlantedEdge, find_slanted_edges, slanted_edge_mtf
from .quality import psnr, ssim

__all__ = ["MtfCurve", "SlantedEdge", "cramer_rao_bound", "find_slanted_edges", "psnr", "slanted_edge_mtf", "ssim"]
