"""Reconstruction of a service's state from the archive, for restarts and for maps of past moments;
checkpoints (saved states) for fast restarts.
"""
