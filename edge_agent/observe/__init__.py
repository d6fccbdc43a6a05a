"""Conversion of estimates along a drive to observations, one per visited map cell. The package is
pure (no I/O).
"""
