"""Sigma-point rules and square-root covariance operations, which all estimators use."""
