"""Predefined questions about an archive, written as Ibis expressions: DuckDB evaluates them on one
machine, Spark on a cluster.
"""
