"""How good a result is: image quality, offset errors, test targets."""

from rsvib_torch.evaluation.quality import offset_endpoint_error, psnr, ssim

__all__ = ["offset_endpoint_error", "psnr", "ssim"]
