"""Stress tests of a twin: deliberate faults, and how soon and how correctly they are detected."""
