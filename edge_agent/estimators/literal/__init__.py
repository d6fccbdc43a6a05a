"""Friction filters of papers 000 and 003 as printed: the motion is given, slip stiffness is
proportional to friction.

They serve reproduction only. A car does not know its motion, and real tyres behave differently. In
a car, the estimators of the registry represent the papers.
"""
