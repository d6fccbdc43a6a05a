"""Assignment of map regions to services: announcement of regions, and hand-over between
services.
"""
