"""Smoothing: a backward pass over a fold, which conditions every estimate on the whole log."""
