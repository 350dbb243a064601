from .page import Box, Report, write_report_page
from .template import BeforeAfter, Blink, Drawing, before_after, blink, drawing, write_page

__all__ = [
    "BeforeAfter",
    "Blink",
    "Box",
    "Drawing",
    "Report",
    "before_after",
    "blink",
    "drawing",
    "write_page",
    "write_report_page",
]
