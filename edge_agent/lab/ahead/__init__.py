"""Evaluation of warnings in the car: their quality, their cost, and the benefit of the map as a
prior.
"""
