"""Filters that carry a mean and a covariance, or its factor."""
