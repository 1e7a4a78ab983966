"""Sealing a proof, running it apart from its answers, and opening it: who saw what, and when, can be checked later."""
