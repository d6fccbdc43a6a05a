"""The live page: the map, its alerts and its past in a web browser. The page has only the access
rights of a reader.
"""
