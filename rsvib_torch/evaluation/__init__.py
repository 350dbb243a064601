"""How good a result is, and how good it can be: image quality, MTF, offset errors, Cramér-Rao bound, test targets."""

from rsvib_torch.evaluation.bound import cramer_rao_bound
from rsvib_torch.evaluation.mtf import MtfCurve, SlantedEdge, find_slanted_edges, slanted_edge_mtf
from rsvib_torch.evaluation.quality import offset_endpoint_error, psnr, ssim
from rsvib_torch.evaluation.scenes import city_and_fields, resolution_chart

__all__ = [
    "MtfCurve",
    "SlantedEdge",
    "city_and_fields",
    "cramer_rao_bound",
    "find_slanted_edges",
    "offset_endpoint_error",
    "psnr",
    "resolution_chart",
    "slanted_edge_mtf",
    "ssim",
]
