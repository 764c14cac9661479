"""Folds beside the running one: pinned, smoothed, sweeps, refits, causes, forecasts."""
