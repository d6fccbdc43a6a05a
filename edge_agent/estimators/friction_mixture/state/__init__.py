"""Constants, tables and memory of the friction mixture (default estimator), and functions that need
only these.
"""
