"""The published state: one message for every output, its JSON Schema included.

An estimate is published with its uncertainty, its validity and its age, or not at all: a value without validity would
be taken for one that holds, and NaN beside a finite value for a number.
"""

from __future__ import annotations

import math
import time
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from estimators.diagnostics.detectors import CALENDAR_FROM_S, is_outside
from estimators.diagnostics.references import state_grades
from estimators.diagnostics.sensitivity import Bound
from estimators.model.parts import State
from estimators.model.state_space import Input
from estimators.track import DEGRADED, DIVERGED, GATED, HEALTH_NAMES, MISSING, SUSPECT, USABLE, USED

from ...result import JsonObject
from ..engine import Engine

SCHEMA: Literal["nisus.state/1"] = "nisus.state/1"

PUBLISHED = tuple(HEALTH_NAMES[code] for code in (*USABLE, SUSPECT, DEGRADED))
"""Grades with which an estimate is published; with the others it is lost, outdated, withheld, or has not begun."""

Name = Annotated[str, Field(min_length=1)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PublishedState(_Part):
    """Estimate of one state. Where it is not valid there is no number; `reason` says why the grade is not tracking."""

    name: Name
    unit: str
    value: float | None = Field(description="mean, in `unit`")
    std: Annotated[float, Field(ge=0.0)] | None = Field(description="standard deviation, in `unit`")
    protection_level: Annotated[float, Field(ge=0.0)] | None = Field(
        description="bound of the error with 95 %, undetected faults included, in `unit`; null while it is not known"
    )
    valid: bool = Field(description="whether it has numbers; only those of tracking and advisory hold")
    grade: Literal["waiting", "tracking", "advisory", "suspect", "degraded", "diverged", "stale", "withheld"]
    reason: str = Field(description="why the grade is not tracking")

    @model_validator(mode="after")
    def _number_or_reason(self) -> PublishedState:
        numbers = self.value is not None and self.std is not None
        if self.valid != numbers or self.valid != (self.grade in PUBLISHED):
            raise ValueError(f"a state that is {', '.join(PUBLISHED)} is valid, with value and std, and no other")
        if bool(self.reason) == (self.grade == "tracking"):
            raise ValueError("a state has a reason unless it is tracking")
        return self


class PublishedInput(_Part):
    """Value of one input. It is not valid outside the range in which the model was fitted."""

    name: Name
    unit: str
    value: float | None
    valid: bool
    reason: str


class PublishedSensor(_Part):
    """One sensor with the counts of its measurements since the start."""

    name: Name
    used: bool = Field(description="whether the estimate uses it; one that is held out is only compared")
    state: str = Field(description="waiting, tracking, advisory, suspect, degraded, stale or held out")
    accepted: int
    rejected: int = Field(description="by the gate")
    dropouts: int = Field(description="measurements without a value")
    nis: float | None = Field(description="mean NIS per degree of freedom of its last measurements, expected 1")


class StateMessage(_Part):
    """State of a twin after its last event."""

    version: Literal["nisus.state/1"] = SCHEMA
    twin: Name
    estimator: Name
    time_ns: int | None = Field(description="time of the state by the clock of its source, ns; null before any event")
    time: str | None = Field(description="the same as ISO 8601 in UTC, if that clock is a calendar")
    sent: str = Field(description="time of sending by the clock of this machine, ISO 8601 in UTC")
    age_s: Annotated[float, Field(ge=0.0)] | None = Field(description="seconds since the last event arrived")
    revision: int = Field(description="increases when the past is estimated again, with another filter or tuning")
    tuning: str | None = Field(description="name of the tuning version; null for one without a name")
    model_version: int = Field(description="increases with each maintenance")
    health: Literal["waiting", "tracking", "advisory", "suspect", "degraded", "diverged", "stale"]
    cause: str
    estimate_valid: bool = Field(description="whether all states are valid")
    inputs_valid: bool = Field(description="whether all inputs are valid")
    nis: float | None = Field(description="mean NIS per degree of freedom of the last window")
    states: tuple[PublishedState, ...]
    inputs: tuple[PublishedInput, ...]
    sensors: tuple[PublishedSensor, ...]
    covariance: tuple[tuple[float, ...], ...] | None = Field(
        description="P in the order of `covariance_of`, on request; null if a state is not valid"
    )
    covariance_of: tuple[Name, ...] | None


def state_message(engine: Engine, *, covariance: bool = False) -> StateMessage:
    """Return the present state of a running twin; with `covariance`, P of all states of the filter."""
    status, model = engine.latest(), engine.model
    tuning, cause = status.tuning, status.cause
    grades = state_grades(model, status.grades, status.health, cause)
    levels = {} if status.integrity is None else status.integrity.bounds
    states = tuple(
        published_state(state, mean, std, grades[state.name], levels.get(state.name))
        for state, mean, std in zip(model.shown_states, status.mean.tolist(), status.std.tolist(), strict=True)
    )
    inputs = [_input(item, float(value)) for item, value in zip(model.inputs, status.inputs, strict=True)]
    sensors = [
        PublishedSensor(
            name=name,
            used=bool(used),
            state=status.sensors[name][0],
            accepted=int(counts[USED]),
            rejected=int(counts[GATED]),
            dropouts=int(counts[MISSING]),
            nis=number_or_none(nis),
        )
        for name, used, counts, nis in zip(
            model.sensor_names, tuning.used, status.sensor_rows, status.sensor_nis, strict=True
        )
    ]
    valid = all(item.valid for item in states)
    P = engine.belief(status.t).cov if covariance and valid else None
    return StateMessage(
        twin=engine.twin.name,
        estimator=status.estimator,
        time_ns=status.t,
        time=calendar_time(status.t),
        sent=iso_now(),
        age_s=None if status.t is None else max(0.0, time.monotonic() - status.heard),
        revision=status.revision,
        tuning=tuning.name or None,
        model_version=status.model_version,
        health=HEALTH_NAMES[status.health],  # type: ignore[arg-type]
        cause=cause,
        estimate_valid=valid,
        inputs_valid=all(item.valid for item in inputs),
        nis=number_or_none(status.nis.ratio),
        states=states,
        inputs=tuple(inputs),
        sensors=tuple(sensors),
        covariance=None if P is None else tuple(map(tuple, P.tolist())),
        covariance_of=None if P is None else tuple(model.state_names),
    )


def published_state(
    state: State, mean: float, std: float, graded: tuple[str, str], level: Bound | None = None
) -> PublishedState:
    """Return one state of a message.

    Args:
        state: The state.
        mean: Its estimate.
        std: Its standard deviation.
        graded: Its grade and reason, of `state_grades`.
        level: Its protection level; None if it is not known.
    """
    if graded[0] in PUBLISHED and not (math.isfinite(mean) and math.isfinite(std)):
        graded = HEALTH_NAMES[DIVERGED], "the estimate is not a number"
    valid = graded[0] in PUBLISHED
    return PublishedState(
        name=state.name,
        unit=state.unit,
        value=mean if valid else None,
        std=std if valid else None,
        protection_level=number_or_none(level.bound) if valid and level is not None else None,
        valid=valid,
        grade=graded[0],  # type: ignore[arg-type]
        reason=graded[1],
    )


def calendar_time(t: int | None) -> str | None:
    """Return a time in ns as ISO 8601, None unless it is of a calendar."""
    return iso(t) if t is not None and t * 1e-9 >= CALENDAR_FROM_S else None


def state_schema() -> JsonObject:
    """Return the JSON Schema of the message."""
    return StateMessage.model_json_schema() | {"$id": SCHEMA}


def _input(item: Input, value: float) -> PublishedInput:
    low, high = item.fitted or (-math.inf, math.inf)
    why = "" if math.isfinite(value) else "the input is not a number"
    if not why and is_outside(item, value):
        why = f"outside {low:.4g} to {high:.4g}, where the model was fitted"
    return PublishedInput(name=item.name, unit=item.unit, value=number_or_none(value), valid=not why, reason=why)


def number_or_none(value: float) -> float | None:
    """Return a number, None unless it is finite."""
    return float(value) if np.isfinite(value) else None


def iso_now() -> str:
    """Return the present time by the clock of this machine as ISO 8601 in UTC."""
    return iso(time.time_ns())


def iso(ns: int) -> str:
    """Return a time in ns as ISO 8601 in UTC, with microseconds."""
    return f"{np.datetime64(ns // 1000, 'us')}Z"
