"""State of a fusion in memory: records, hash tables and pools that grow. Layout: README.md here.
Pure.
"""
