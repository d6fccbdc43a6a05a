"""Fault campaigns: what `make faults` runs. See `frame.py` for how one is added."""
