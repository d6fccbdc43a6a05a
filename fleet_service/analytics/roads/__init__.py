"""Road networks: links, and the assignment of the map's cells and heading sectors to links."""
