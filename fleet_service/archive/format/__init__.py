"""File format of an archive: file names, versions, segments (files of new rows), map snapshots, and
reading.
"""
