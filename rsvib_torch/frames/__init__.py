"""Input preparation: arrays, dtypes, full scale, masks and orientation of stacks of frames."""
