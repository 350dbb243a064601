from .export.angular_rates import write_gcsv
from .export.community_sensor_model import camera_isd, write_isd
from .export.pixel_map import sampling_map, write_stmap
from .html.page import Box, Report, write_report_page
from .plots import (
    comparison_figure,
    gain_figure,
    motion_figure,
    mtf_figure,
    offset_figure,
    psf_figure,
    rows_figure,
    save_figure,
    windows_figure,
)
from .results import (
    check_same_timing,
    load_detection,
    read_vibration,
    restoration_data,
    write_columns,
    write_offsets,
    write_restoration,
    write_table,
    write_vibration,
)

__all__ = [
    "Box",
    "Report",
    "camera_isd",
    "check_same_timing",
    "comparison_figure",
    "gain_figure",
    "load_detection",
    "motion_figure",
    "mtf_figure",
    "offset_figure",
    "psf_figure",
    "read_vibration",
    "restoration_data",
    "rows_figure",
    "sampling_map",
    "save_figure",
    "windows_figure",
    "write_columns",
    "write_gcsv",
    "write_isd",
    "write_offsets",
    "write_report_page",
    "write_restoration",
    "write_stmap",
    "write_table",
    "write_vibration",
]
