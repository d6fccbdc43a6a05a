"""Parts that all estimators share: checked readings, grip in use, arrays and records of small
filters.
"""
