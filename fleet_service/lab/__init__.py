"""`fleet-service evaluate`: simulated fleets through the real fusion, beside the truth and
simple rules.
"""
