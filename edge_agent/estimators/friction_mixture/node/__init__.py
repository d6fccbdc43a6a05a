"""Filter of one node (friction hypothesis): prediction, residuals of the measurements, and
update.
"""
