from .page import Box, Report, write_report_page
from .template import BeforeAfter, Drawing, before_after, data_uri, drawing, write_page

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
