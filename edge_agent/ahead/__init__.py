"""The map in front of the car: horizon (knowledge about each metre ahead), warnings, safe speed,
and the map as a prior of the friction estimate.
"""
