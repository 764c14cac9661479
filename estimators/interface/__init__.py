"""The interface for scripts and notebooks: a filter over a log, everything by name."""
