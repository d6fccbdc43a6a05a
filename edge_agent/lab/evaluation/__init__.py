"""Evaluation of estimators (`edge-agent evaluate`): the papers' manoeuvres for every estimator,
with figures, a table and plots.
"""
