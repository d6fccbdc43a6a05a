"""Fault campaigns of `make faults`; `frame.py` explains how to add one."""
