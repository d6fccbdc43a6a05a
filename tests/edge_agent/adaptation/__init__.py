"""Tests of edge_agent.adaptation."""
