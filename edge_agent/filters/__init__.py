"""Sigma rules and square roots of covariances: the one core that every estimator is assembled from."""
