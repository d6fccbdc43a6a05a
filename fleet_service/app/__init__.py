"""The running service: engine, sessions, jobs, metrics."""
