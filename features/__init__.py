"""Temperature rises, lags and grey degrees from batches, and the selectors of temperature-sensitive points."""
