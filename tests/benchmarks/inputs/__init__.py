"""Evaluation of the inputs: readers of files, signal doctor (a check of recorded signals),
calibration, and live sources.
"""
