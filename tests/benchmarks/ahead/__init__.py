"""Evaluation of the look ahead in the car: quality and cost of the warnings, and benefit of the map
as a prior.
"""
