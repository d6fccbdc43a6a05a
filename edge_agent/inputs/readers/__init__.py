"""Readers of foreign recordings: each gives a `Recording`; libraries are imported when they are
used.
"""
