"""Signals in: a recorded log; each source gives blocks of samples."""
