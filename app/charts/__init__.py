"""Charts: rows of a run as few points, with levels of detail, and their colors."""
