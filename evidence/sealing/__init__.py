"""Sealing a proof, running it in isolation from its keys, and opening it, with a record that can be verified later."""
