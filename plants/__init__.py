"""Development plants: simulated machines of their own numerics, to try a diagnosis on; nothing here uses the twin."""
