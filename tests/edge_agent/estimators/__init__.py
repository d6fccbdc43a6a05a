"""Tests of edge_agent.estimators."""
