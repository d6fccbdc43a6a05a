"""The demo: a router, a fleet service and a fleet of simulated vehicles, and what came out of it beside the truth."""
