from .html import Box, Report, write_report_page
from .plots import comparison_figure, measured_text, offset_figure, save_figure
from .results import read_vibration, write_offsets, write_restoration, write_vibration, write_windows

__all__ = [
    "Box",
    "Report",
    "comparison_figure",
    "measured_text",
    "offset_figure",
    "read_vibration",
    "save_figure",
    "write_offsets",
    "write_report_page",
    "write_restoration",
    "write_vibration",
    "write_windows",
]
