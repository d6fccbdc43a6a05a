"""Export from an archive: extracts as tables, and a mirror of its files."""
