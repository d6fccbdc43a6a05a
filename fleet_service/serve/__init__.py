"""Output of the map: cells, tiles, queries, alerts."""
