"""Configuration of the small test stacks; each test appends its own sections."""

CAMERA = """
[sensor]
row_time = 1e-4
exposure_rows = 6
frame_rows = 104
full_scale = 4095

[detection]
method = "bands"
band_rows = 16
band_step = 8
search = 6
tones = 1

[restoration]
method = "dewarp"
"""
