"""State of a fusion in memory: records, hash tables, and pools (arrays of reusable rows) that grow.
README.md in this folder describes the layout. Pure.
"""
