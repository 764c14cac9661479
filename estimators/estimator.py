"""What a filter is: four compiled functions over a flat state, and an entry that describes it.

The state of a filter is one float64 array, so it can be copied, kept and restored without knowing the filter. The
four functions read the context and change nothing else:

    start(context, mean, cov, state)                                 the state that stands for N(mean, cov)
    predict(context, u, dt, index, state, work)                      dt seconds forward, in place
    update(context, u, sensor, y, index, state, work, innovation, innovation_std, score) -> verdict
    describe(context, state, mean, std, cross)                       what the track shows of it

`index` numbers the event in the log. Randomness goes not by it but by a filter's own count of its predictions and
updates, which is part of the state (`next_draw`): the sub-steps of one event (`max_step`) then differ, queries change
no draw, and a refold draws what the fold drew.

`work` is scratch that starts as NaN. `score` takes NIS, degrees of freedom, log-likelihood, how many particles count,
from how many they descend, and the normal scores of the rows (`track.WHITENED`).

The functions of an `interpreted` filter are plain Python, and its context is a `View` (interpreted/view.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

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


Options = dict[str, float]
"""Values of an estimator's options by name."""


class Option(NamedTuple):
    """One option of an estimator: where its value starts, and the range and unit that a panel offers.

    An option whose default is an int is a count: its value must be a whole number. One with `choices` has the position
    of one of them as its value.
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
        """An option that is one of several words."""
        return Option(name, float(default), 0.0, len(choices) - 1.0, "", meaning, choices)


class Code(NamedTuple):
    """Addresses of a filter's four functions."""

    start: Any
    predict: Any
    update: Any
    describe: Any


code_type = types.NamedUniTuple(i64, len(Code._fields), Code)


@dataclass(frozen=True)
class Estimator:
    """One entry of the catalogue.

    `applies(model)` gives the reason why the estimator does not fit a model, or None; `refuses(model, options)` why it
    does not with these options. `options` are complete here (see `complete`). `state_size(options, nx)` and
    `work_size(options, nx, ny)` count float64s; `moments(options, state, nx)` gives mean and covariance,
    `points(options, state, nx)` what to draw beside the mean (sigma points, particles) as (k, nx), `peaks(options,
    state, nx)` the peaks where there can be several, `recoveries(state)` how often the filter had to recover since its
    start, `account(options, state, nx)` what only this filter can say of itself. `tune(options, model, tuning)` turns
    the options into the numbers that the compiled functions read; it may raise EstimatorError. `memory(options, model)`
    counts numbers that the state holds beyond `state_size`. `runs(options, nx)` is `model_runs` as a number: how often
    a step runs f. `prepare(model, options)` computes what depends on the model too, once for a fold, as int64s.
    `blocks(options, state, nx)` is a view of the members (N, nx) in a state, of a compiled filter that runs f and h at
    these alone and so can run on a black box (interpreted/). `fixed_r` says that its gain is for one R, so that no
    reading can bring its own; `needs_factor` that it cannot start from a covariance without a Cholesky factor;
    `singular` that P and R may be singular: states that are certain at first, rows of a sensor without noise.
    """

    name: str
    title: str
    family: str
    assumes: str
    model_runs: str
    fails_when: str
    source: str
    functions: tuple[Any, Any, Any, Any]
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

    def complete(self, options: Mapping[str, float | str]) -> dict[str, float]:
        """The given options and the defaults of the others; one of several words may be given as the word.

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
        """The value of an option, of a word its place among the choices."""
        if isinstance(given, str):
            if given in option.choices:
                return float(option.choices.index(given))
            wanted = f"one of {', '.join(option.choices)}" if option.choices else "a number"
            raise EstimatorError(f"estimator {self.name}: {option.name} is {quoted(given)}; it must be {wanted}")
        try:
            return float(given)
        except (TypeError, ValueError):
            wanted = f"one of {', '.join(option.choices)}" if option.choices else "a number"
            raise EstimatorError(f"estimator {self.name}: {option.name} is {given!r}; it must be {wanted}") from None

    def complete_for(self, model: StateSpaceModel, options: Mapping[str, float | str]) -> dict[str, float]:
        """The given options and the defaults of the others, for a model.

        Raises:
            EstimatorError: As `complete` does, or if the model refuses them.
        """
        values = self.complete(options)
        reason = self.refuses(model, values)
        if reason:
            raise EstimatorError(f"estimator {self.name}: {reason}")
        return values

    def code(self) -> Code:
        """Compile the four functions, or load them from the cache; or, if interpreted, the functions themselves."""
        return Code(*self.functions) if self.interpreted else _code(self.functions)


@lru_cache(maxsize=64)
def _code(functions: tuple[Any, Any, Any, Any]) -> Code:
    signatures = (start_signature, predict_signature, update_signature, describe_signature)
    return Code(*(address(function, signature) for function, signature in zip(functions, signatures, strict=True)))
