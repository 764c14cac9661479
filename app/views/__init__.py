"""Viser, Rerun and recordings."""
