"""`fleet-service evaluate`: simulated fleets through the real fusion, compared with the truth and
with simple rules.
"""
