"""Tests of the square-root filters (`edge_agent.filters`)."""
