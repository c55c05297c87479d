"""What people read: the page and the file that `dtprob diagnose` writes, and figures for other rooms."""

from dtprob.report.json_schema import Report, to_json, validate
from dtprob.report.page import render

__all__ = ["Report", "render", "to_json", "validate"]
