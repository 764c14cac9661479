"""Faults on demand: one layer over any source, which spoils what it says and stamps since when into the log."""
