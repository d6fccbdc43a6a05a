"""Parts that several estimators share: plausibility check of readings, grip in use (force over
load), array helpers, and the sample loop of the filters from papers.
"""
