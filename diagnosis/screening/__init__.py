"""What each candidate gains, all of them from one linearisation."""
