"""Simulated machine tools of lumped bodies: the sample year, the sample lathe, and types to draw machines from."""
