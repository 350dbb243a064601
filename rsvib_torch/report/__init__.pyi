from .html import Box, Report, write_report_page
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
from .results import read_vibration, write_offsets, write_restoration, write_vibration, write_windows

__all__ = [
    "Box",
    "Report",
    "comparison_figure",
    "gain_figure",
    "motion_figure",
    "mtf_figure",
    "offset_figure",
    "psf_figure",
    "read_vibration",
    "rows_figure",
    "save_figure",
    "windows_figure",
    "write_offsets",
    "write_report_page",
    "write_restoration",
    "write_vibration",
    "write_windows",
]
