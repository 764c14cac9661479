"""Fault injection: a layer over any source that changes its events and marks the faults in the log."""
