"""Tests of edge_agent.filters."""
