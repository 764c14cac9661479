"""Pure numerics: models, the log, the fold, the filters, diagnostics. No I/O, no clock."""
