"""Maintenance of an archive: compaction (move of new rows into sorted files), retention, roll-up,
Iceberg tables, reserved disk space.
"""
