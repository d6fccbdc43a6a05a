"""Readers of recordings in formats of other tools. Each reader returns a `Recording`. Optional
libraries are imported at first use.
"""
