"""Output of the map: cells, tiles, answers to queries, alerts."""
