"""Questions to the archive, written once as Ibis expressions: DuckDB runs them on one machine,
Spark on a cluster.
"""
