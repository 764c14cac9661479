"""Filters that carry weighted particles."""
