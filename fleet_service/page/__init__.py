"""The live page: the map, its alerts and its past in a browser, with the rights of a reader."""
