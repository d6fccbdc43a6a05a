"""A vehicle learned from its own drives: what its devices and tyres are off by, with standard
deviations.
"""
