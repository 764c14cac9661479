"""The thread that folds, and what it takes and gives."""
