"""Filters that carry an ensemble and never form a covariance."""
