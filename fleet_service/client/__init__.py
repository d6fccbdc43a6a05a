"""Clients of the map: query it, watch it, forward its alerts."""
