"""Clients of the map: they query it, watch it, and forward its alerts."""
