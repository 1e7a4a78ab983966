"""Opening a sealed proof, and what its names and sizes alone give away."""
