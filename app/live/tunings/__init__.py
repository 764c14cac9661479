"""Tuning versions: made of what runs or was fitted, kept, accepted, loaded, listed and compared."""
