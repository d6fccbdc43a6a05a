"""The signal doctor, an automatic check of a drive's signals. It finds faults from physical
relations between signals, and corrects them.
"""
