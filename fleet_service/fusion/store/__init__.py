"""State of a fusion (beliefs about all cells) in memory: records, hash tables, and pools (arrays of
reusable rows) that grow. README.md in this folder describes the layout. Pure (no I/O).
"""
