"""Friction filters of papers 000 and 003 as printed: the motion is given, slip stiffness is
proportional to friction.

They are for reproduction alone. A car does not know its motion, and real tyres are not of that
kind; the estimators of the registry stand for the papers in a car.
"""
