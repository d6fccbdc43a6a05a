"""Weights of the nodes: evidence, trust, change of the road and ice patches."""
