from .pixels import check_mosaic as check_mosaic
from .pixels import colour_frames as colour_frames
from .pixels import enlarged as enlarged
