"""Plant B: castings as bars and plates of finite volumes."""
