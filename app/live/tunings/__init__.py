"""Tuning versions: made from a run or a fit, kept, accepted, loaded and listed."""
