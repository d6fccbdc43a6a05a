"""The signal doctor, an automatic check of a drive's signals: it finds faults by physical relations
between signals, and corrects them.
"""
