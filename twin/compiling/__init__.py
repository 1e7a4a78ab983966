"""Compilation of the twin part group by group; `twin.compile` assembles the network."""
