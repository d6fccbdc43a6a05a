"""Evaluation of the agent's look ahead, which receives the map of the road ahead: quality and cost
of the warnings, and benefit of the map as a prior of the estimated friction.
"""
