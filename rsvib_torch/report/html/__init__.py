"""Self-contained HTML pages: figures, tables and text in one file that needs no network."""

from rsvib_torch.report.html.page import Box, Report, write_report_page
from rsvib_torch.report.html.template import BeforeAfter, Drawing, before_after, data_uri, drawing, write_page

__all__ = [
    "BeforeAfter",
    "Box",
    "Drawing",
    "Report",
    "before_after",
    "data_uri",
    "drawing",
    "write_page",
    "write_report_page",
]
