"""Output of the fleet service to readers: map cells, tiles, answers to queries, alerts."""
