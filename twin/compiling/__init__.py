"""Readers of the twin part, one for each of its groups; `twin.compile` puts a network together from them."""
