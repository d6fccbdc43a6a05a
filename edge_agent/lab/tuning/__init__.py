"""Tuning of the fuzzy memberships: ant colony, random search for comparison, objectives, and tuned
files with their origin.
"""
