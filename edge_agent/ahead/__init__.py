"""The map in front of the car: horizon, warnings, safe speed, and the map as a prior of the
friction estimate.
"""
