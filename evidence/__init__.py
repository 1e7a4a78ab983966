"""Evidence: the sealed examination of the diagnosis, and published studies reproduced."""
