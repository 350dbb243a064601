from .bound import cramer_rao_bound
from .mtf import MtfCurve, SlantedEdge, find_slanted_edges, slanted_edge_mtf
from .quality import offset_endpoint_error, psnr, ssim
from .scenes import city_and_fields, resolution_chart
from .scenes.example_frames import example_frames

__all__ = [
    "MtfCurve",
    "SlantedEdge",
    "city_and_fields",
    "cramer_rao_bound",
    "example_frames",
    "find_slanted_edges",
    "offset_endpoint_error",
    "psnr",
    "resolution_chart",
    "slanted_edge_mtf",
    "ssim",
]
