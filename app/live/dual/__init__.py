"""Dual estimation: parameters fitted again while the twin runs, and what becomes of what is found."""
