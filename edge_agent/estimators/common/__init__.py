"""Parts that all estimators share: plausibility check of readings, grip in use (force over load),
array helpers, and the sample loop of the papers' filters.
"""
