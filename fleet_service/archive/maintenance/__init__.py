"""Maintenance of an archive: compaction, retention, roll-up, Iceberg tables, reserved disk
space.
"""
