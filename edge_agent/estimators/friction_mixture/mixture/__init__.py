"""Probabilities (weights) of the friction hypotheses: evidence, trust in the model, changes of the
road, and ice patches.
"""
