"""`edge-agent evaluate`: the papers' manoeuvres for every estimator, as figures, a table and
plots.
"""
