"""The signal doctor: finds faults in a drive's signals by physical relations between them, and
corrects the faults.
"""
