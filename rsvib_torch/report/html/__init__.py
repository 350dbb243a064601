"""Self-contained HTML pages: pictures, tables and words in one file that needs no network."""

from rsvib_torch.report.html.inline import BeforeAfter, Drawing, before_after, data_uri, drawing
from rsvib_torch.report.html.page import Report, write_report_page
from rsvib_torch.report.html.sharpness import Box
from rsvib_torch.report.html.template import write_page

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
