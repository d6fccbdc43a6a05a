"""Reconstruction of a service's state from the archive: restarts, checkpoints and past moments."""
