"""Regression suite: figures of recordings against those that were accepted."""
