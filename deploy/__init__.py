"""Programs and files that start the parts: the router, configurations, and the demo."""
