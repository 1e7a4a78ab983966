"""Sealing cases, answering them in isolation, opening them, and what their names and sizes alone give away."""
