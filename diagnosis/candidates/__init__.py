"""What may be missing and where: mechanisms at places, and the rivals that need no new physics."""
