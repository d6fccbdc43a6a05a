"""Friction filters of papers 000 and 003 as printed. The motion is given, and slip stiffness is
proportional to friction.

These filters only serve to reproduce the papers. A car does not know its true motion, and real
tyres behave differently. In a car, the papers' estimators in `registry` are used instead.
"""
