"""Tuning of the fuzzy memberships: ant colony, random control, objective, tuned files with
provenance.
"""
