"""Benchmarks of interfaces for the Internet of Vehicles: DENM messages at an interchange, and
routes around ice.
"""
