"""Real recordings as cases of the proof: how they are read, which runs make a case, what an answer key says of them."""
