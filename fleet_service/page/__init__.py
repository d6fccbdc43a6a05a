"""The live page: the map, its alerts and its past in a browser, asked as any reader asks."""
