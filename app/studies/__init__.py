"""Studies over a log: advice, analysis, comparison, fits."""
