"""Export from an archive: selected rows as tables, and a mirror (copies of its files on another
file system).
"""
