"""What all estimators share: believable readings, what is used of the grip, arrays and records
of small filters.
"""
