"""Recordings: machine files, readers, checks, and the Parquet lake."""
