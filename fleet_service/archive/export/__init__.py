"""Copies of an archive for others: extracts as tables, and a mirror."""
