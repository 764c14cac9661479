"""The definition of a filter: four compiled functions over a flat state, and an entry that describes it.

The state of a filter is one float64 array, so it can be copied, kept and restored without knowledge of the filter.
The four functions only read the context:

    start(context, mean, cov, state)                                 set the state to N(mean, cov)
    predict(context, u, dt, index, state, work)                      dt seconds forward, in place
    update(context, u, sensor, y, index, state, work, innovation, innovation_std, score) -> verdict
    describe(context, state, mean, std, cross)                       fill the track's columns

`index` numbers the event in the log. Random numbers do not depend on it but on a filter's own count of predictions and
updates, which is part of the state (`next_draw`): the sub-steps of one event (`max_step`) then differ, queries do not
change later draws, and folding again draws the same numbers.

`work` is scratch that starts as NaN. `score` takes NIS, degrees of freedom, log-likelihood, effective sample size,
number of ancestors, and the normal scores of the rows (`track.WHITENED`).

The functions of an `interpreted` filter are plain Python, and its context is a `View` (interpreted/view.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import types

from .compiled.context import context_type
from .errors import EstimatorError, nearest, quoted
from .model.state_space import StateSpaceModel
from .numerics.jit import F1, F2, address, caller, f64, i64
from .numerics.peaks import Peak
from .tuning import Tuning

start_signature = types.void(context_type, F1, F2, F1)
predict_signature = types.void(context_type, F1, f64, i64, F1, F1)
update_signature = i64(context_type, F1, i64, F1, i64, F1, F1, F1, F1, F1)
describe_signature = types.void(context_type, F1, F1, F1, F1)

call_start = caller(start_signature)
call_predict = caller(predict_signature)
call_update = caller(update_signature)
call_describe = caller(describe_signature)


Entry: TypeAlias = Any  # Address of a compiled function, or a function in Python
Options = dict[str, float]
"""Values of an estimator's options by name."""


class Option(NamedTuple):
    """Option of an estimator: default, range and unit.

    An option with an int as default is a count, whose value must be a whole number. The value of one with `choices` is
    the position of a choice.
    """

    name: str
    default: float
    low: float
    high: float
    unit: str
    meaning: str
    choices: tuple[str, ...] = ()

    @property
    def whole(self) -> bool:
        """Whether its value must be a whole number."""
        return isinstance(self.default, int)

    @staticmethod
    def choice(name: str, choices: tuple[str, ...], meaning: str, default: int = 0) -> Option:
        """Return an option that is one of several words."""
        return Option(name, float(default), 0.0, len(choices) - 1.0, "", meaning, choices)


class Code(NamedTuple):
    """Addresses of a filter's four functions."""

    start: Entry
    predict: Entry
    update: Entry
    describe: Entry


code_type = types.NamedUniTuple(i64, len(Code._fields), Code)


CONSTANT, TANGENT, POINTS = range(3)
"""Prediction rule of a filter: the one F of a linear model, the tangent of f at the estimate, sigma points."""

COVARIANCE, FACTOR, MEMBERS, TRAJECTORIES = range(4)
"""Form of the covariance in a filter's state: P, a factor of it, the members of an ensemble, or particles' paths."""


class SmoothingRule(NamedTuple):
    """Prediction rule (CONSTANT, TANGENT, POINTS; unused for members and particles), and form of the covariance."""

    rule: int
    holds: int = COVARIANCE


@dataclass(frozen=True)
class Estimator:
    """Entry of the catalogue.

    `options` are complete in all these calls (see `complete`):

    - `applies(model)` returns why the estimator does not apply to a model, or None; `refuses(model, options)` why it
      does not with these options.
    - `state_size(options, nx)`, `work_size(options, nx, ny)` and `memory(options, model)` count float64s of the state,
      of scratch, and of the state beyond `state_size`.
    - `moments(options, state, nx)` returns mean and covariance, `points(options, state, nx)` sigma points or particles
      (k, nx) to draw, `peaks(options, state, nx)` the peaks of a distribution that can have several,
      `recoveries(state)` the number of recoveries since the start, `account(options, state, nx)` further figures.
    - `tune(options, model, tuning)` returns the numbers that the compiled functions read, and may raise
      EstimatorError; `prepare(model, options)` returns int64s that depend on the model, once per fold.
    - `runs(options, nx)` is `model_runs` as a number: evaluations of f per step.
    - `blocks(options, state, nx)` is a view of the members (N, nx) of a compiled filter that evaluates f and h only at
      these, and so can run on a black box (interpreted/).

    `fixed_r`: the gain is for one R, so that measurements cannot have their own. `needs_factor`: the filter needs the
    Cholesky factor of its initial covariance. `singular`: P and R may be singular. `considers`: a model may have
    considered states. `linearises`: derivatives stand for f and h. `samples`: the estimate is that of a random sample,
    so that it has noise of its own; a fold of a compiled one uses all processors. `smoothing`: how it is smoothed, None
    if it cannot be.
    """

    name: str
    title: str
    family: str
    assumes: str
    model_runs: str
    fails_when: str
    source: str
    functions: tuple[Callable, Callable, Callable, Callable]
    state_size: Callable[[Options, int], int]
    work_size: Callable[[Options, int, int], int]
    moments: Callable[[Options, np.ndarray, int], tuple[np.ndarray, np.ndarray]]
    points: Callable[[Options, np.ndarray, int], np.ndarray]
    options: tuple[Option, ...] = ()
    tune: Callable[[Options, StateSpaceModel, Tuning], np.ndarray] = lambda options, model, tuning: np.zeros(1)
    memory: Callable[[Options, StateSpaceModel], int] = lambda options, model: 0
    prepare: Callable[[StateSpaceModel, Options], np.ndarray] = lambda model, options: np.zeros(1, np.int64)
    applies: Callable[[StateSpaceModel], str | None] = lambda model: None
    refuses: Callable[[StateSpaceModel, Options], str | None] = lambda model, options: None
    runs: Callable[[Options, int], float] = lambda options, nx: 1.0
    peaks: Callable[[Options, np.ndarray, int], list[Peak]] | None = None
    recoveries: Callable[[np.ndarray], int] | None = None
    account: Callable[[Options, np.ndarray, int], dict[str, float | list[float]]] | None = None
    interpreted: bool = False
    fixed_r: bool = False
    needs_factor: bool = False
    blocks: Callable[[Options, np.ndarray, int], np.ndarray] | None = None
    singular: bool = False
    considers: bool = False
    linearises: bool = False
    samples: bool = False
    smoothing: SmoothingRule | None = None

    @property
    def marginal(self) -> bool:
        """Whether its predictions are not Gaussian, so that `Track.whitened` holds each row by itself."""
        return self.family in ("particle", "ensemble")

    def complete(self, options: Mapping[str, float | str]) -> dict[str, float]:
        """Return the given options and the defaults of the others; a choice may be given as its word.

        Raises:
            EstimatorError: If an option is unknown, out of its range, or a fraction where it is a count.
        """
        known = {option.name: option for option in self.options}
        values = {}
        for name, given in options.items():
            if name not in known:
                raise EstimatorError(f"estimator {self.name} has no option {quoted(name)}; {nearest(name, known)}")
            option = known[name]
            values[name] = value = self._number(option, given)
            if not option.low <= value <= option.high:
                raise EstimatorError(
                    f"estimator {self.name}: {name} is {value:g}; it must lie between {option.low:g} and "
                    f"{option.high:g}"
                )
            if option.whole and value != int(value):
                raise EstimatorError(
                    f"estimator {self.name}: {name} is {value:g}; it must be a whole number, such as {int(value)}"
                )
            if option.choices and value != int(value):
                codes = ", ".join(f"{code} ({choice})" for code, choice in enumerate(option.choices))
                raise EstimatorError(f"estimator {self.name}: {name} is {value:g}; it must be one of {codes}")
        return {option.name: float(values.get(option.name, option.default)) for option in self.options}

    def _number(self, option: Option, given: float | str) -> float:
        """Return the value of an option; for a word its position among the choices."""
        try:
            return float(option.choices.index(given) if isinstance(given, str) else given)
        except (TypeError, ValueError):
            wanted = f"one of {', '.join(option.choices)}" if option.choices else "a number"
            shown = quoted(given) if isinstance(given, str) else repr(given)
            raise EstimatorError(f"estimator {self.name}: {option.name} is {shown}; it must be {wanted}") from None

    def complete_for(self, model: StateSpaceModel, options: Mapping[str, float | str]) -> dict[str, float]:
        """Return the given options and the defaults of the others, for a model.

        Raises:
            EstimatorError: As `complete`, or if they do not apply to the model.
        """
        values = self.complete(options)
        reason = self.refuses(model, values)
        if reason:
            raise EstimatorError(f"estimator {self.name}: {reason}")
        return values

    def code(self) -> Code:
        """Return the four functions, compiled or loaded from the cache; those of an interpreted filter unchanged."""
        return Code(*self.functions) if self.interpreted else _code(self.functions)


@lru_cache(maxsize=64)
def _code(functions: tuple[Callable, Callable, Callable, Callable]) -> Code:
    signatures = (start_signature, predict_signature, update_signature, describe_signature)
    return Code(*(address(function, signature) for function, signature in zip(functions, signatures, strict=True)))
