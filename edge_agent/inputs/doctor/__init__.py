"""The signal doctor: by physics and not by names, what is wrong with a drive's signals, and how
to mend it.
"""
