"""Tuning versions: made of what runs or was fitted, kept, accepted, listed and compared."""
