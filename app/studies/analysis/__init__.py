"""Analyses of a running twin that are computed on request: forecast and diagnosis."""
