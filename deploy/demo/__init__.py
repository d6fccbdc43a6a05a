"""The demo: a router, a fleet service and a fleet of simulated vehicles. The map is compared with
the true road.
"""
