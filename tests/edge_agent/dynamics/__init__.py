"""Tests of the vehicle and tyre equations (`edge_agent.dynamics`)."""
