"""File format of an archive: names, versions, segments, reading, snapshots."""
