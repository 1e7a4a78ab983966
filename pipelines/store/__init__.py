"""What is kept: the tracking store, the registry and its log, fitted models as files, checkpoints."""
