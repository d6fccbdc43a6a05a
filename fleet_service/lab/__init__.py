"""Evaluation of the fleet service (`fleet-service evaluate`): simulated fleets report to the real
fusion, and the map is compared with the true road and with simple rules.
"""
