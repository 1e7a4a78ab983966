"""The comparison report: one page from tracked trainings, as HTML or Markdown, and small pictures for the store."""

from pipelines.report.pngs import figure_pngs
from pipelines.report.write import write_report

__all__ = ["figure_pngs", "write_report"]
