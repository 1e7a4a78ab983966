"""Plants: simulated machines with independent numerics for testing a diagnosis; nothing here uses the twin."""
