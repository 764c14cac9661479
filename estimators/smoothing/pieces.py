"""What smoothing compiles, by the types with which it is called; see estimators/pieces.py."""

from __future__ import annotations

from typing import Any

from numba import types

from ..compiled.context import context_type
from ..estimator import code_type, describe_signature, predict_signature, start_signature, update_signature
from ..numerics.jit import B1, F1, F2, I1, i64
from .backward import Moments, backward, note_queries, step_back, tell
from .recorder import Step, describe, predict, start, update

_F3 = types.Array(types.float64, 3, "C")
_moments = types.NamedTuple((F1, F2), Moments)
_step = types.NamedTuple((F1, F1, F1, F2, F2, F1, i64), Step)

PIECES: tuple[tuple[Any, tuple[Any, ...]], ...] = (
    (predict, predict_signature.args),
    (start, start_signature.args),
    (update, update_signature.args),
    (describe, describe_signature.args),
    (backward, (context_type, i64, B1, i64, i64, _moments, _moments, _F3, F2, F2, F2, _F3)),
    (note_queries, (code_type, context_type, i64, I1, B1, F2, i64, F1, i64, i64, F1, F1, i64, i64)),
    (step_back, (context_type, _step, F1, F2, F2, F2)),
    (tell, (context_type, F1, F2, F1, F1, F1)),
)
"""Functions and the types of their arguments; what takes longest first."""
