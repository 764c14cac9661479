"""Fit a tuning to recorded logs: objective, uncertainty, held-out scores, proposal."""
