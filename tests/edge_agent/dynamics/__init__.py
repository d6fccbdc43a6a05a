"""Tests of edge_agent.dynamics."""
