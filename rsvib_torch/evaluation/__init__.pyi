from .bound import cramer_rao_bound
from .quality import psnr, ssim
from .slanted_edge import MtfCurve, slanted_edge_mtf

__all__ = ["MtfCurve", "cramer_rao_bound", "psnr", "slanted_edge_mtf", "ssim"]
