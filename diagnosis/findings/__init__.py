"""From the search to findings, sentences and tables."""
