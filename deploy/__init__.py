"""Putting the parts to work: the router, configurations, and the demo."""
