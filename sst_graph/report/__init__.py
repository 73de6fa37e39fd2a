"""The report of a calibration: one HTML page that needs nothing else."""

from sst_graph.report.page import ReportInputs, report_html

__all__ = ["ReportInputs", "report_html"]
