"""Which estimator for a twin, and why: a tree of claims, each with the figure that made it."""
