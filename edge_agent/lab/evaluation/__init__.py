"""Evaluation of estimators (`edge-agent evaluate`): every estimator runs on the papers' manoeuvres,
and the results are reported as numbers, a table and plots.
"""
