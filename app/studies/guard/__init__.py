"""The regression suite: archived recordings folded with their accepted tunings, and compared with recorded scores."""
