from .bound import cramer_rao_bound
from .mtf import MtfCurve, slanted_edge_mtf
from .quality import psnr, ssim

__all__ = ["MtfCurve", "cramer_rao_bound", "psnr", "slanted_edge_mtf", "ssim"]
