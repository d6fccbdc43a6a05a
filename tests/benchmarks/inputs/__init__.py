"""Evaluation of the agent's inputs: import of recorded files, signal doctor (automatic check of the
signals), calibration, and live sources.
"""
