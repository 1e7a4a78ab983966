"""What may be missing and where: mechanisms at places, and the alternatives that need no new physics."""
