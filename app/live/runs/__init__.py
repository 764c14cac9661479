"""Runs: scores, sweeps over a parameter, noise estimates, fits and refits, as JSON for the page."""
