"""Tests of the friction estimators (`edge_agent.estimators`)."""
