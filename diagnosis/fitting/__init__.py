"""Fits of a twin part to batches: least squares under the covariance of their structure."""
