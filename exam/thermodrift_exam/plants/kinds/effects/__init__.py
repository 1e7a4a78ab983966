"""Effects that any kind may have: heats, exchanges, error terms, faults; a kind says where it has which."""
