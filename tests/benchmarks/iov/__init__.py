"""Benchmarks of the interfaces of the Internet of Vehicles: DENM at an interchange, and routes
around ice.
"""
