"""The run that would distinguish tied explanations."""
