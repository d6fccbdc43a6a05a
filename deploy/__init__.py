"""Programs and files that start the parts of GripMap: the router, configurations, and the demo."""
