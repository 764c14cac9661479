"""Forecasts of a running twin: fold on from the present state, return the answer as JSON."""

from __future__ import annotations

import math
import time
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from estimators.diagnostics.references import HALF_WIDTH
from estimators.errors import LARGEST, ConfigError
from estimators.forecast import Crossing, Forecast, first_time, forecast
from estimators.log import INPUT, Events
from estimators.model.state_space import StateSpaceModel

from ..engine.copies import MAX_PULL_ROWS, Here
from ..engine.running_fold import Running
from ..result import JsonObject
from .row_figures import listed, number

MAX_CHANGES = 200  # changes of one input
MAX_COMPUTING_S = 8.0  # seconds that a forecast may take to compute
DEFAULT_STEP_S = 1.0  # step after a single measurement
SHARES = (0.1, 0.5, 0.9)  # probabilities of crossing a limit whose times are returned
REPEAT = "repeat"  # in place of an input's values: those that it had before

Changes = Annotated[list[tuple[FiniteFloat, FiniteFloat]], Field(min_length=1, max_length=MAX_CHANGES)]
"""Changes of one input: seconds from now, and the value from then on."""


@dataclass(frozen=True)
class ForecastQuestion:
    """Horizon (s), changes by input, and limits by state in its unit.

    An input has one value from now on, pairs of seconds from now and the value from then on, or `REPEAT`: it repeats
    its values of the last seconds, as long as the horizon.
    """

    horizon: Annotated[FiniteFloat, Field(gt=0.0, lt=1e9)]
    inputs: dict[str, FiniteFloat | Literal["repeat"] | Changes] = field(default_factory=dict)
    limits: dict[str, FiniteFloat] = field(default_factory=dict)

    def check(self, model: StateSpaceModel) -> None:
        """Check names and times.

        Raises:
            ConfigError: If the model has no such input or state, or an input changes after the horizon.
        """
        shown = [state.name for state in model.shown_states]
        for where, asked, names in (
            ("inputs", list(self.inputs), model.input_names),
            ("limits", list(self.limits), shown),
        ):
            unknown = next((name for name in asked if name not in names), None)
            if unknown is not None:
                raise ConfigError(f"forecast: {where} names {unknown!r}; there are {', '.join(names) or 'none'}")
        for name, changes in self.inputs.items():
            times = [t for t, _ in changes] if isinstance(changes, list) else []
            late = next((t for t in times if not 0.0 <= t <= self.horizon), None)
            if late is not None:
                raise ConfigError(
                    f"forecast: inputs.{name} changes at {late:g} s; it must be between 0 and the horizon"
                )


class Forecasts:
    """Forecasts of one running twin, from any thread but the engine's."""

    def __init__(self, engine: Running) -> None:
        self._engine = engine

    def may(self) -> JsonObject:
        """Return the longest horizon and the length of a step, s.

        Raises:
            ConfigError: If nothing has come yet.
        """
        step = _step(self._here(), 0.0, self._engine.model.max_step)
        return {"step": step, "longest": MAX_STEPS * step}

    def _here(self) -> Here:
        here = self._engine.here()
        if here is None:
            raise ConfigError("forecast: no reading has come yet, so there is no estimate to go on from")
        return here

    def compute(self, question: ForecastQuestion) -> JsonObject:
        """Forecast from the present estimate.

        The answer is that of `forecast_json`.

        Raises:
            NisusError: If nothing has come yet, the question is too large, or `forecast` refuses it.
        """
        begun = time.monotonic()
        question.check(self._engine.model)
        here = self._here()
        step = _step(here, question.horizon, self._engine.model.max_step)
        repeated = [name for name, given in question.inputs.items() if given == REPEAT]
        inputs = {
            name: given if isinstance(given, list) else [(0.0, given)]
            for name, given in question.inputs.items()
            if not isinstance(given, str)
        } | recorded(self._engine, repeated, here.t, question.horizon)

        def between() -> None:
            if time.monotonic() - begun > MAX_COMPUTING_S:
                raise ConfigError(
                    f"forecast: {question.horizon:g} s in steps of {step:.3g} s take longer than {MAX_COMPUTING_S:g} s "
                    f"to compute with {here.estimator}; ask for a shorter horizon"
                )

        found = forecast(
            here.estimator,
            self._engine.model,
            here.tuning,
            here.base,
            here.t,
            question.horizon,
            step,
            inputs=input_events(inputs, here.t, self._engine.model),
            limits=question.limits,
            most=MAX_TIMES,
            between=between,
        )
        lost = (~(np.abs(found.mean) <= LARGEST) & np.isfinite(found.mean[0])).any(axis=1)
        if lost.any():
            raise ConfigError(
                f"forecast: {float(found.t[np.argmax(lost)]):.4g} s from now a state is beyond {LARGEST:g}, or no "
                "number; are the inputs possible? or ask for a shorter horizon"
            )
        told = forecast_json(self._engine.model, here, found, self._engine.status().withheld)
        chosen = {name: drawn_changes(changes) for name, changes in inputs.items()}
        return {**told, "chosen": chosen, "step": step, "took": time.monotonic() - begun}


def forecast_json(model: StateSpaceModel, here: Here, found: Forecast, withheld: Container[str]) -> JsonObject:
    """Return a forecast as JSON.

    `now` is in seconds of the log, `t` in seconds from then; `states` have mean and the edges of their ± 1σ and ± 2σ
    bands, a probability its mean alone; the mean is null where the state is withheld, or among those `withheld` now.
    `inputs` are those that hold now. Of each limit: whether it is looked at from below, the probability of it over the
    horizon and at each time, and when that is 10, 50 and 90 %. Bands are cut at the physical limits of a state; when
    one is beyond them the forecast ends.

    Raises:
        ConfigError: If an estimate is impossible now.
    """
    least, most = np.array([state.limits or (-np.inf, np.inf) for state in model.shown_states]).T
    left = (found.bands[:, -1] < least) | (found.bands[:, 0] > most)
    end, ends = len(found.t), ""
    if left.any():
        k = int(np.argmax(left.any(axis=1)))
        name = model.shown_states[int(np.argmax(left[k]))].name
        if k == 0:
            raise ConfigError(f"forecast: {name} is impossible now, so it has no future; see its episode")
        end, ends = k + 1, f"; the forecast ends after {found.t[k]:.4g} s, when {name} leaves its physical limits"
    found = found._replace(
        t=found.t[:end], mean=np.clip(found.mean[:end], least, most), bands=np.clip(found.bands[:end], least, most)
    )
    bands = {}
    for j, state in enumerate(model.shown_states):
        spread = float(np.nanmedian(found.std[:, j])) if np.isfinite(found.std[:, j]).any() else 0.0
        size = float(np.nanmax(np.abs(found.mean[:, j]), initial=0.0))
        # Digits down to a hundredth of σ: a place on the earth needs more than a temperature.
        digits = int(np.clip(3 + math.ceil(math.log10(size / spread)), 4, 14)) if spread > 0.0 < size else 8
        edges = {} if int(model.shown[j]) == model.mode else dict(zip(_EDGES, found.bands[:, :, j].T, strict=True))
        hidden = (found.std[:end, j] > state.withhold / HALF_WIDTH) | (state.name in withheld)
        mean = np.where(hidden, np.nan, found.mean[:, j])
        bands[state.name] = {name: listed(values, digits) for name, values in {"mean": mean, **edges}.items()}
    return {
        "now": here.t * 1e-9,
        "revision": here.revision,
        "estimator": here.estimator,
        "members": found.members,
        "method": (
            f"share of {found.members} members that have passed the limit"
            if found.members
            else "probability of being beyond the limit, by mean and σ at each time"
        )
        + ends,
        "t": listed(found.t),
        "states": bands,
        "inputs": dict(zip(model.input_names, listed(here.base.u), strict=True)),
        "limits": {item.state: _crossing(item, found.t) for item in found.crossings},
    }


_EDGES = ("lower2", "lower1", "upper1", "upper2")


def _crossing(item: Crossing, t: np.ndarray) -> JsonObject:
    probability = item.probability[: t.size]
    early, middle, late = (number(first_time(t, probability, share)) for share in SHARES)
    return {
        "limit": item.limit,
        "above": item.above,
        "probability": listed(probability, 3),
        "overall": number(np.max(probability), 3),
        "early": early,
        "middle": middle,
        "late": late,
    }


def _step(here: Here, horizon: float, longest: float) -> float:
    """Return the recent time between measurements, at most the step that the model allows."""
    step = min(here.step if math.isfinite(here.step) else DEFAULT_STEP_S, longest)
    steps = math.ceil(horizon / step)
    if steps > MAX_STEPS:
        raise ConfigError(
            f"forecast: horizon is {horizon:g} s, {steps:,} steps of {step:.3g} s as the readings come; it may be "
            f"{MAX_STEPS * step:.4g} s at most"
        )
    return step


MAX_STEPS = 20_000  # steps of a forecast; each is as long as the time between measurements
MAX_TIMES = 160  # times in the answer


def recorded(engine: Running, names: Sequence[str], now: int, horizon: float) -> dict[str, Changes]:
    """Return the inputs of the last `horizon` seconds before `now` (ns) as changes from now on; repeat a shorter log.

    Raises:
        ConfigError: If they changed too often.
    """
    if not names:
        return {}
    model = engine.model
    since = max(engine.span()[0], now - round(horizon * 1e9))
    length = max(1, now - since)
    places = {name: model.input_names.index(name) for name in names}
    before: dict[str, float] = {}
    found: dict[str, Changes] = {name: [] for name in names}
    # From some rows before, for what held at first.
    at, end = max(0, engine.index_at(since) - MAX_PULL_ROWS), engine.index_at(now + 1)
    while at < end:
        events = engine.rows(at, min(end, at + MAX_PULL_ROWS)).events
        at += MAX_PULL_ROWS
        for row in np.flatnonzero(events.kind == INPUT):
            for name, place in places.items():
                value = float(events.value[row, place])
                if math.isnan(value):
                    continue
                if events.t[row] <= since:
                    before[name] = value
                else:
                    found[name].append(((int(events.t[row]) - since) * 1e-9, value))
    times = math.ceil(horizon * 1e9 / length)
    for name, changes in found.items():
        changes[:0] = [(0.0, before[name])] if name in before else []
        if len(changes) * times > MAX_STEPS:
            raise ConfigError(
                f"forecast: {name} changed {len(changes):,} times in {length * 1e-9:.4g} s, too often to be repeated "
                f"for {horizon:g} s; ask for a shorter horizon"
            )
    return {
        name: [
            (t + k * length * 1e-9, value)
            for k in range(times)
            for t, value in changes
            if t + k * length * 1e-9 <= horizon
        ]
        for name, changes in found.items()
        if changes
    }


def drawn_changes(changes: Changes) -> dict[str, list[object]]:
    """Return the changes of an input as points to draw."""
    few = changes[:: max(1, math.ceil(len(changes) / (2 * MAX_TIMES)))]
    return {"t": listed(np.array([t for t, _ in few])), "value": listed(np.array([value for _, value in few]))}


def input_events(inputs: Mapping[str, Changes], now: int, model: StateSpaceModel) -> Events | None:
    """Return the changes of the inputs as events."""
    batch = []
    for name, changes in inputs.items():
        t = np.array([now + round(seconds * 1e9) for seconds, _ in changes], np.int64)
        rows = np.full((t.size, model.width), np.nan)
        rows[:, model.input_names.index(name)] = [value for _, value in changes]
        batch.append(Events.alike(INPUT, t, rows))
    return Events.concat(batch, model.width) if batch else None
