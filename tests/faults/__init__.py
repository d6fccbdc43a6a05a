"""Fault campaigns (tests of the whole system under failures) of `make faults`. The docstring of
`frame.py` explains how to add one.
"""
