"""The proof: the diagnosis examined on recordings in which the effect is concealed."""
