"""Use of the map in the car: horizon (the map's knowledge about each metre ahead), warnings, safe
speed, and the map as a prior of the friction estimate.
"""
