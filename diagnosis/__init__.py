"""What physics did a simulation leave out? Located, named, modelled and shown on batches left out."""
