"""Tuning of the fuzzy memberships (parameters of the fuzzy sets): ant colony optimisation, random
search for comparison, objectives, and the files of tuned memberships with a record of their search.
"""
