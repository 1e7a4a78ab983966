"""The run that would tell tied explanations apart."""
