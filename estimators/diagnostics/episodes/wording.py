"""Facts of an episode, by which the wording and the remedy in the table of detectors are formatted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...compiled.model import compile_model
from ...errors import spaced
from ...model.state_space import StateSpaceModel
from ...model.wrapping import indicator
from ..detectors import since

CORRELATED_FROM = 0.15  # Lag-1 correlation of the innovations from which Q explains their scale, not R


MAX_STATES = 64  # States up to which the states that a sensor observes are listed


def observed_states(model: StateSpaceModel) -> np.ndarray:
    """Return which states each sensor's measurement depends on at the prior, (sensors, nx) of bool.

    None of a model with more than `MAX_STATES`, or with a function of its own in place of equations.
    """
    observed = np.zeros((len(model.sensors), model.nx), bool)
    if model.nx > MAX_STATES or model.black_box:
        return observed
    compiled = compile_model(indicator(model))
    x0, u, p = model.prior_mean.copy(), model.default_inputs, model.default_parameters
    for s, sensor in enumerate(model.sensors):
        y, moved = np.empty(len(sensor.rows)), np.empty(len(sensor.rows))
        compiled.h[s](x0, u, p, y)
        for j in range(model.nx):
            x = x0.copy()
            x[j] += 0.1 * model.prior_std[j] or 1e-3
            compiled.h[s](x, u, p, moved)
            observed[s, j] = bool(np.any(moved != y))
    return observed


@dataclass(frozen=True, kw_only=True)
class EpisodeFacts:
    """Facts of any episode.

    size: see `Detector.effect`. about: mean of the innovations of a row, or error of a state, in `unit`.
    """

    cause: str
    start: float
    size: float = np.nan
    unit: str = ""
    about: float = np.nan

    @property
    def since(self) -> str:
        """Start of the episode."""
        return since(self.start)

    @property
    def spaced_unit(self) -> str:
        """Unit, as it follows a number."""
        return spaced(self.unit)

    @property
    def percent(self) -> float:
        """Size as a percentage."""
        return 100.0 * self.size

    @property
    def offset(self) -> str:
        """Absolute value of `about`, with its unit."""
        return f"{abs(self.about):.3g}{self.spaced_unit}"


@dataclass(frozen=True, kw_only=True)
class SensorFacts(EpisodeFacts):
    """Facts of an episode of sensor s, or of its row k.

    correlation: lag-1 correlation of the innovations. reasons: limits that the measurements violate. lasted: duration
    of a dropout that is over, s.
    """

    model: StateSpaceModel
    s: int
    k: int | None = None
    correlation: float = 0.0
    reasons: str = ""
    lasted: float | None = None

    @property
    def sensor(self) -> str:
        """Name of the sensor."""
        return self.model.sensors[self.s].name

    @property
    def name(self) -> str:
        """Name of the row, or of the sensor."""
        return self.sensor if self.k is None else self.model.row_names[self.model.row_start[self.s] + self.k]

    @property
    def sigmas(self) -> float:
        """Absolute size."""
        return abs(self.size)

    @property
    def side(self) -> str:
        """Side of the prediction."""
        return "above" if self.about > 0 else "below"

    @property
    def process_noise(self) -> str:
        """Tuning keys of the process noises that act on the states which the sensor observes."""
        model = self.model
        observed = set(np.flatnonzero(observed_states(model)[self.s]).tolist())
        names = [noise.name for noise in model.noises if set(model.acts_on(noise.name)) & observed]
        return " or ".join(f"Q.{name}" for name in names[:3]) or "Q"

    @property
    def variance(self) -> str:
        """Tuning key that explains a wrong scale of the innovations: Q where they are correlated, else R."""
        correlated = self.correlation if self.size > 1.0 else -self.correlation
        return self.process_noise if correlated > CORRELATED_FROM else f"R.{self.name}"

    @property
    def observed_by(self) -> str:
        """Whether other sensors observe the same states."""
        observed = observed_states(self.model)
        others = np.delete(observed, self.s, axis=0).any(axis=0)
        only = [self.model.state_names[int(j)] for j in np.flatnonzero(observed[self.s] & ~others)][:4]
        if not only:
            return "other sensors measure the same states"
        named = f"{', '.join(only[:-1])} and {only[-1]}" if only[1:] else only[0]
        return f"{named} {'is' if len(only) == 1 else 'are'} measured by no other sensor"

    @property
    def held(self) -> str:
        """Why a sensor repeats its value: it is stuck, or saturated at an end of its measuring range."""
        limits = self.model.sensors[self.s].limits
        ends = (limits.range or limits.ends) if limits else ()
        return "saturated" if ends and np.isclose(ends[(self.k or 0) % len(ends)], self.size).any() else "stuck"

    @property
    def cross_check(self) -> str:
        """First step to find out whether the sensor or the twin is wrong."""
        if len(self.model.sensors) == 1:
            return "check the sensor; if it is right, reset the twin"
        return f"hold {self.sensor} out to see whether the other sensors agree"

    @property
    def dropout(self) -> str:
        """Description of a dropout."""
        if self.lasted is not None:
            if self.cause == "never heard":
                return f"reported for the first time after {self.lasted:.3g} s"
            return f"did not report for {self.lasted:.3g} s, {self.since}"
        return "has never reported" if self.cause == "never heard" else f"has not reported {self.since}"


@dataclass(frozen=True, kw_only=True)
class TwinFacts(EpisodeFacts):
    """Facts of an episode of a state, an input or the twin.

    limits: range in which the model was fitted. ancestors: particles from which all descend. off: sensors that
    contradict the estimate, of `sensors` in all.
    """

    name: str
    limits: str = ""
    ancestors: str = ""
    off: tuple[str, ...] = ()
    sensors: int = 0

    @property
    def contradiction(self) -> str:
        """Sensors that contradict a lost estimate."""
        if not self.off:
            return ""
        names = ", ".join(self.off[:4]) + (", ..." if len(self.off) > 4 else "")
        return f", and {names} still {'contradict' if len(self.off) > 1 else 'contradicts'} it"

    @property
    def reset_advice(self) -> str:
        """Step before a reset: while a fault lasts, a reset starts from its measurements."""
        if not self.off:
            return "reset the twin to its prior, then check the sensor that was in alarm first"
        if self.sensors == 1:
            return "check the sensor; if it is right, reset the twin"
        first = "hold them out first, one by one," if len(self.off) > 1 else "hold it out first,"
        return f"{first} and reset the twin when the others agree"


def return_text(cause: str, start: float) -> str:
    """Return what is added while the alarm of a sensor that has recovered has not cleared."""
    if cause == "stuck":
        return f"it moves again {since(start)}"
    return f"back to normal {since(start)}: the alarm clears after more such measurements"
