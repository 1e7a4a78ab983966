"""Models of the error: their numerics, the families, and the selection of one."""
