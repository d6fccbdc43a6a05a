"""File format of an archive: file names, versions, segments, snapshots, and reading."""
