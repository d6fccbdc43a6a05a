"""The signal doctor: finds faults in a drive's signals by physics, not by names, and corrects
them.
"""
