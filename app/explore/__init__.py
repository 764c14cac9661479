"""Rerun: live series, and the layout of recordings."""
