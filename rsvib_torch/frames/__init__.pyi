from .mosaic import check_mosaic as check_mosaic
from .mosaic import colour_frames as colour_frames
from .pixels import enlarged as enlarged
