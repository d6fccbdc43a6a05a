"""Vehicle and tyre equations as compiled scalar functions, independent of filters, files and
clocks.
"""
