"""Studies over a log: advice, analysis, stress, guard."""
