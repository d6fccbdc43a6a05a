"""Sigma-point rules and square-root covariance operations, which the papers' estimators use."""
