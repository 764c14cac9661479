"""Filters and folds in plain Python: black boxes, and FilterPy as a second opinion."""
