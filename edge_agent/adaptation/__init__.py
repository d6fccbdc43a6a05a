"""Fuzzy adaptation of the measurement noise on the mismatch of innovation covariances."""

from edge_agent.adaptation.memberships import Memberships

__all__ = ["Memberships"]
