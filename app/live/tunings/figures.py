"""What a fold was worth as figures by name: those that a tuning version is listed and guarded by."""

from __future__ import annotations

import numpy as np

from estimators.diagnostics.score import Score

NIS, LIKELIHOOD, RMSE, COVERAGE, REFUSED = "nis", "log_likelihood", "rmse", "coverage", "refused"


def figures(found: Score) -> dict[str, float]:
    """Sum a score up; only what is a number: a fold without truth, and without a sensor held out, has no RMSE.

    Returns:
        `nis`, `log_likelihood` of a reading, `refused` (a share), and for each state whose truth is known and each
        sensor row held out `rmse.NAME` in its unit and `coverage.NAME` as a share; `rmse.field` for all cells of a
        large field.
    """
    judged = found.nis_readings + found.gated
    fits = {**found.states, **found.held_out, **({"field": found.field} if found.field is not None else {})}
    known = {
        NIS: found.nis,
        LIKELIHOOD: found.log_likelihood / judged if judged else np.nan,
        REFUSED: found.refused,
        **{f"{RMSE}.{name}": fit.rmse for name, fit in fits.items()},
        **{f"{COVERAGE}.{name}": fit.coverage for name, fit in fits.items()},
    }
    return {name: float(value) for name, value in known.items() if np.isfinite(value)}
