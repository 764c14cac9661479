"""Compiled filters on a black box: Python runs the block, the filter's own code does the rest.

An ensemble or particle filter runs f and h at its members and nowhere else. So the block of members goes through the
executor first; then the compiled function runs as ever, and where it calls f or h, it gets the answer that stands for
the member at that address.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..compiled.black_box import ANSWER
from ..compiled.context import with_parameters
from ..estimator import Code, Estimator
from .view import View


def driven(entry: Estimator) -> Code:
    """The four functions of an estimator for a black box, over a `View`."""
    if entry.interpreted:
        return entry.code()
    entry.code()  # compiles them
    start, predict, update, describe = entry.functions
    assert entry.blocks is not None
    members = entry.blocks

    def answering(view: View, X: np.ndarray, answers: np.ndarray) -> Any:
        """The context in which f, or h, of the members X is known; valid for as long as both arrays are."""
        if "answers" not in view.kept:
            p = np.append(view.p, np.zeros(ANSWER))
            view.kept["answers"] = p, with_parameters(view.context, p)
        p, context = view.kept["answers"]
        # Addresses of 48 bits are exact in a float64.
        p[-ANSWER:] = X.ctypes.data, answers.ctypes.data
        return context

    def start_driven(view: View, mean: np.ndarray, cov: np.ndarray, state: np.ndarray) -> None:
        start(view.context, mean, cov, state)

    def predict_driven(view: View, u: np.ndarray, dt: float, index: int, state: np.ndarray, work: np.ndarray) -> None:
        X = members(view.options, state, view.nx)
        forward = view.f(X, u, dt)
        predict(answering(view, X, forward), u, dt, index, state, work)

    def update_driven(
        view: View,
        u: np.ndarray,
        sensor: int,
        y: np.ndarray,
        index: int,
        state: np.ndarray,
        work: np.ndarray,
        *rest: Any,
    ) -> int:
        X = members(view.options, state, view.nx)
        expected = view.h(sensor, X, u)
        return int(update(answering(view, X, expected), u, sensor, y, index, state, work, *rest))

    def describe_driven(view: View, state: np.ndarray, mean: np.ndarray, std: np.ndarray, cross: np.ndarray) -> None:
        describe(view.context, state, mean, std, cross)

    return Code(start_driven, predict_driven, update_driven, describe_driven)
