"""Sigma rules and the square-root predict and update that every estimator is assembled from."""
