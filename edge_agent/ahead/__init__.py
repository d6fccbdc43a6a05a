"""Use of the map in the car: the map's values for each metre ahead ("horizon"), warnings, a safe
speed, and the map as a prior of the friction estimate.
"""
