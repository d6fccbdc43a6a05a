"""Tests of the fuzzy adaptation (`edge_agent.adaptation`)."""
