"""The map out: cells, tiles, queries, alerts."""
