"""The comparison report: one page from tracked trainings, as HTML or Markdown, and small pictures for the store."""

from reports.comparison.page import write_report
from reports.comparison.pngs import figure_pngs

__all__ = ["figure_pngs", "write_report"]
