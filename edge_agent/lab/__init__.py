"""The laboratory: simulation, evaluation and tuning of the estimators. The code that is evaluated
never imports it.
"""
