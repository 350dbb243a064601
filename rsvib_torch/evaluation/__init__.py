"""How good a result is: image quality, offset errors, test targets."""

from rsvib_torch.evaluation.quality import offset_endpoint_error, psnr, ssim
from rsvib_torch.evaluation.targets import city_and_fields, resolution_chart

__all__ = ["city_and_fields", "offset_endpoint_error", "psnr", "resolution_chart", "ssim"]
