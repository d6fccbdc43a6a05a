"""Benchmarks of interfaces for the Internet of Vehicles: DENM (hazard messages) at an interchange,
and routes around ice.
"""
