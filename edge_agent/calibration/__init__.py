"""Calibration of a vehicle learned from its own drives: systematic errors of its sensors and tyre
data, with standard deviations.
"""
