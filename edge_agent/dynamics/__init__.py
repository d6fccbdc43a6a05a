"""Vehicle and tyre equations as compiled scalar functions; they do not depend on filters, files or
clocks.
"""
