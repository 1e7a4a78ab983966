"""Recordings in: machine files, readers, checks, the Parquet lake and the sample year."""
