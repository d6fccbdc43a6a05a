"""Friction filters of papers 000 and 003 as printed. The motion is given, and slip stiffness is
proportional to friction.

They serve reproduction only. A car does not know its motion, and real tyres behave differently. In
a car, the papers' estimators in the registry are used instead.
"""
