"""Parts that several papers' filters share: planar process model, federated motion filter, and
friction of four wheels.
"""
