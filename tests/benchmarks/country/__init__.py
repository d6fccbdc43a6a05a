"""Benchmarks on a city with real streets and speeds, and on a country made of copies of the city's
reports.
"""
