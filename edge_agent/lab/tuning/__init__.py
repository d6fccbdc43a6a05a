"""Tuning of the fuzzy memberships: ant colony optimisation, random search for comparison,
objectives, and files of tuned memberships that state how they were found.
"""
