"""An advice as JSON, for scripts and the page."""

from __future__ import annotations

from math import isfinite
from typing import Any

from estimators.log import Log

from ...twin.twin import Twin
from .lines import lasting_lines, lines
from .verdict import Advice


def advice_json(twin: Twin, log: Log, told: Advice) -> dict[str, Any]:
    """`estimator`, `options`, `because`, `claims` with figure and threshold, `lines`, `remedies`."""
    return {
        "twin": twin.name,
        "has": twin.estimator,
        "seconds": float(log.t[log.n - 1] - log.t[0]) * 1e-9,
        "estimator": told.estimator,
        "options": told.options,
        "because": list(told.because),
        "reasons": told.reasons,
        "claims": [
            {
                "key": claim.key,
                "question": claim.question,
                "answer": claim.answer,
                "figure": _number(claim.figure),
                "threshold": _number(claim.threshold),
                "of": claim.of,
                "reason": claim.reason,
                "remedy": claim.remedy,
            }
            for claim in told.claims
        ],
        "lines": lines(told) + lasting_lines(told),
        "remedies": told.remedies,
    }


def _number(value: float | None) -> float | None:
    return None if value is None or not isfinite(value) else float(value)
