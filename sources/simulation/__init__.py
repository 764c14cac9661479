"""Simulated assets, and faults on demand."""
