"""The archive: all admitted reports as durable Parquet files, and the keys that turn vehicle names
into pseudonyms.
"""
