"""Readers of foreign recordings. Each returns a `Recording`; optional libraries are imported at
first use.
"""
