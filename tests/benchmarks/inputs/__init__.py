"""Evaluation of the inputs: readers, signal doctor, calibration, and live sources."""
