"""Learned corrections of a model: training data from recordings, training, and judging; see model/correction.py."""
