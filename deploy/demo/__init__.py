"""The demo: a router, a fleet service and a fleet of simulated vehicles, compared with the
truth.
"""
