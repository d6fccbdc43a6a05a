"""Fuzzy adaptation of the measurement noise R from the mismatch between actual and theoretical
innovation variance. An innovation is a measurement minus its prediction.
"""

from edge_agent.adaptation.memberships import Memberships

__all__ = ["Memberships"]
