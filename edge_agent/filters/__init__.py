"""Sigma-point rules and square-root covariance operations for the papers' estimators."""
