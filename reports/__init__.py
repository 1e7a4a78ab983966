"""Reports: pages, tables and pictures from what the inner rooms return."""
