"""The machine file with what was found in it."""
