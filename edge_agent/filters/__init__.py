"""Sigma rules and square roots of covariances: the core of every estimator."""
