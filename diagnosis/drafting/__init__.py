"""The simplest network that recordings support, where a machine file has no twin part."""
