"""The interface for scripts and notebooks: a filter over a log, everything by name.

    from estimators import MODELS, Log, fold

    model = MODELS["motor_winding"]
    log = Log.of(model, start=0.0)
    log.add("winding", seconds, celsius)
    track = fold("ukf", model, log, R={"winding": 9.0}, alpha=0.5)

Names become a `Tuning`, and the fold is the one that live twins run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from multiprocessing import get_context
from pickle import PicklingError
from typing import Any

import numba
import numpy as np

from ..compiled.orphan import leave_with_parent
from ..diagnostics.consistency import Nees, nees
from ..diagnostics.episodes import Course, Episode, found_in
from ..diagnostics.health import HealthPolicy
from ..diagnostics.score import Score, score
from ..errors import ConfigError, EstimatorError
from ..fold import Fold
from ..fold import fold as fold_track
from ..log import READING, Events, Log
from ..model.state_space import StateSpaceModel
from ..registry import checked, find_estimator
from ..smoothing.smooth import check_smooth, smooth
from ..track import Track
from ..tuning import Tuning
from .table import table_of

__all__ = ["fold", "fold_many"]

Prior = tuple[Any, Any]
Values = Mapping[str, Any]


def fold(
    estimator: str,
    model: StateSpaceModel,
    log: Log,
    *,
    R: Values | None = None,
    Q: Values | None = None,
    p: Values | None = None,
    held_out: str | Iterable[str] = (),
    gate: float | None = None,
    seed: int = 0,
    prior: Prior | None = None,
    covariance: bool = False,
    smoothed: bool = False,
    policy: HealthPolicy | None = None,
    tuning: Tuning | None = None,
    **options: float | str,
) -> Estimates:
    """Fold an estimator over a log.

    Args:
        estimator: Its name, such as "ukf"; all are in `ESTIMATORS`.
        model: What the log is of.
        log: Events, inputs, true states.
        R: Variances of sensor noise, in the rows' units squared: by sensor (one number, or one for each row), or by
            row, "gnss.east".
        Q: Variances that the process noises add in a second, by name.
        p: Parameters by name.
        held_out: Sensors that are predicted and scored, never used.
        gate: The probability that a good reading passes, such as 0.997; None for no gate.
        seed: Of all that the filter draws.
        prior: Mean (nx,) and covariance (nx, nx), positive semidefinite, in place of the model's; a row of zeros is a
            state that is known exactly.
        covariance: Keep the whole covariance at every event, for `Estimates.cov` and `Estimates.nees`.
        smoothed: Give mean, deviations and covariances of the states given all readings, those that came later too;
            innovations, verdicts and health stay the filter's.
        policy: When the estimate may be trusted.
        tuning: What the names above change; None for what the model declares.
        **options: The estimator's own, by name; one of several words as the word: `resampling="stratified"`.

    Returns:
        The estimates, one row an event.

    Raises:
        EstimatorError: If the estimator does not exist, does not apply or cannot be smoothed, an option or the prior
            breaks a rule.
        ConfigError: If a name is unknown or a value breaks its rule.
        EventError: If the log is of another model.
        ModelError: If the model's functions disagree with its declaration, or those of a black box fail.
    """
    tuned = tuned_by_name(estimator, model, tuning, R, Q, p, held_out, gate, seed, options)
    _check_named(log, model)
    pairs = all_pairs(model) if covariance else None
    if smoothed:
        check_smooth(find_estimator(estimator, model), model, tuned.options)
        folded = Fold(estimator, model, tuned, log, pairs=pairs, policy=policy, prior=prior)
        folded.advance()
        track = smooth(folded).instead_of(folded.track)
    else:
        track = fold_track(estimator, model, tuned, log, pairs=pairs, policy=policy, prior=prior)
    return _estimates(estimator, model, tuned, _copied(log), track, covariance)


def fold_many(
    estimator: str,
    model: StateSpaceModel,
    log: Log | Sequence[Log],
    *,
    seeds: Iterable[int] = (0,),
    executor: Executor | str | None = "threads",
    R: Values | None = None,
    Q: Values | None = None,
    p: Values | None = None,
    held_out: str | Iterable[str] = (),
    gate: float | None = None,
    prior: Prior | None = None,
    covariance: bool = False,
    policy: HealthPolicy | None = None,
    tuning: Tuning | None = None,
    **options: float | str,
) -> list[Estimates]:
    """Fold an estimator over one log or several, with several seeds: a Monte Carlo study.

    Args:
        estimator: As `fold`; so are all that are not named here.
        model: What the logs are of.
        log: One, or several.
        seeds: Of the folds; each log is folded with each.
        executor: "threads" (folds run beside each other, as compiled code gives up the interpreter), "processes" (for
            FilterPy's filters and black boxes; `f` and `h` must stand by their names in a module), any
            concurrent.futures.Executor, or None for one after the other. The results are the same bits.
        R: As `fold`.
        Q: As `fold`.
        p: As `fold`.
        held_out: As `fold`.
        gate: As `fold`.
        prior: As `fold`.
        covariance: As `fold`.
        policy: As `fold`.
        tuning: As `fold`.
        **options: As `fold`.

    Returns:
        Estimates of the first log with every seed, then of the second, and so on.

    Raises:
        NisusError: As `fold`.
        EstimatorError: If processes cannot be given the model.
    """
    logs = [log] if isinstance(log, Log) else list(log)
    pairs = all_pairs(model) if covariance else None
    first = tuned_by_name(estimator, model, tuning, R, Q, p, held_out, gate, 0, options)
    jobs = [(each, _seeded(first, seed)) for each in logs for seed in list(seeds)]
    for each in logs:
        _check_named(each, model)
        # Compiles, and finds what is wrong, before anybody waits for it.
        Fold(estimator, model, first, each, pairs=pairs, policy=policy, prior=prior)
    given = [(estimator, model, tuned, each, pairs, policy, prior) for each, tuned in jobs]
    with _pool(executor) as pool:
        if pool is None:
            tracks = [_track(*one) for one in given]
        else:
            try:
                futures = [pool.submit(_track, *one) for one in given]
                tracks = [future.result() for future in futures]
            except (PicklingError, AttributeError, TypeError) as error:
                if "pickle" not in str(error):
                    raise
                raise EstimatorError(
                    f"fold_many: processes cannot be given {model.name} ({error}); let its functions stand by their "
                    'names in a module, or use executor="threads"'
                ) from None
    copies = {id(each): _copied(each) for each in logs}
    return [
        _estimates(estimator, model, tuned, copies[id(each)], track, covariance)
        for (each, tuned), track in zip(jobs, tracks, strict=True)
    ]


def _track(
    estimator: str,
    model: StateSpaceModel,
    tuning: Tuning,
    log: Log,
    pairs: np.ndarray | None,
    policy: HealthPolicy | None,
    prior: Prior | None,
) -> Track:
    return fold_track(estimator, model, tuning, log, pairs=pairs, policy=policy, prior=prior)


def _pool(executor: Executor | str | None) -> Any:
    """A context that gives an executor, which it ends if it is its own; or None."""
    if executor is None or isinstance(executor, Executor):
        return nullcontext(executor)
    count = int(numba.config.NUMBA_NUM_THREADS)
    if executor == "threads":
        return ThreadPoolExecutor(count)
    if executor == "processes":
        # Spawned, not forked: a fork would copy the locks of threads that it does not copy.
        return ProcessPoolExecutor(count, get_context("spawn"), initializer=leave_with_parent)
    raise EstimatorError(
        f"fold_many: executor is {executor!r}; it must be 'threads', 'processes', None or a concurrent.futures.Executor"
    )


def _check_named(log: Log, model: StateSpaceModel) -> None:
    """Refuse a log whose names mean other channels; a model with other states may well fold it.

    Raises:
        EstimatorError: If its sensors or inputs are not the model's.
    """
    if log.model is None or log.model is model:
        return
    for what, names, wanted in (
        ("sensors", log.model.sensor_names, model.sensor_names),
        ("inputs", log.model.input_names, model.input_names),
    ):
        if names != wanted:
            raise EstimatorError(
                f"the log is of {log.model.name}, with the {what} {', '.join(names[:8]) or 'none'}; {model.name} has "
                f"{', '.join(wanted[:8]) or 'none'}: make the log by Log.of(model)"
            )


def _copied(log: Log) -> Events:
    """The log's events now, whatever comes later."""
    return Events(*(column.copy() for column in log.events))


def _estimates(
    estimator: str, model: StateSpaceModel, tuning: Tuning, events: Events, track: Track, covariance: bool
) -> Estimates:
    return Estimates(estimator=estimator, model=model, tuning=tuning, events=events, track=track, covariance=covariance)


def all_pairs(model: StateSpaceModel) -> np.ndarray:
    """Every pair of states i < j, (nx (nx - 1) / 2, 2)."""
    if len(model.shown) < model.nx:
        raise EstimatorError(
            f"covariance: {model.name} has {model.nx:,} states, of which a track keeps some; leave it out"
        )
    return np.stack(np.triu_indices(model.nx, 1), axis=1)


def _seeded(tuning: Tuning, seed: int) -> Tuning:
    # A seed is 64 bits of the draws' place; a float or a negative one would be another than was meant.
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < 2**63:
        raise ConfigError(f"seed is {seed!r}; it must be a whole number from 0 on")
    return replace(tuning, seed=int(seed))


def tuned_by_name(
    estimator: str,
    model: StateSpaceModel,
    tuning: Tuning | None,
    R: Values | None,
    Q: Values | None,
    p: Values | None,
    held_out: str | Iterable[str],
    gate: float | None,
    seed: int,
    options: Mapping[str, float | str],
) -> Tuning:
    """A tuning with what is given by name.

    Raises:
        NisusError: If a name is unknown or a value breaks its rule.
    """
    entry = find_estimator(estimator, model)
    tuned = Tuning.of(model) if tuning is None else tuning
    for group, values in (("R", R), ("Q", Q), ("p", p)):
        if values is not None and not isinstance(values, Mapping):
            name = {"R": model.sensor_names, "Q": tuple(n.name for n in model.noises)}.get(group, ("name",))[0]
            raise ConfigError(f"{group} is {values!r}; it must be given by name, such as {{{name!r}: 1.0}}")
        for name, value in (values or {}).items():
            for key, number in _entries(group, name, value, model):
                tuned = tuned.set(key, number)
    for name in (held_out,) if isinstance(held_out, str) else held_out:
        tuned = tuned.set(f"use.{name}", False)
    if gate is not None:
        tuned = tuned.set("gate", gate)
    if options:
        given: dict[str, float | str] = {**tuned.options, **options}
        values = checked(entry, model, given)
        tuned = tuned.with_options({name: values[name] for name in given})
    return _seeded(tuned, seed)


def _entries(group: str, name: str, value: Any, model: StateSpaceModel) -> list[tuple[str, float]]:
    """Keys of a tuning and their values; of a sensor with several rows a value may be one for each."""
    given = np.asarray(value)
    if given.dtype.kind not in "iufb":
        raise ConfigError(f"{group}[{name!r}] is {value!r}; it must be a number")
    if given.ndim == 0:
        return [(f"{group}.{name}", float(given))]
    sensor = model.sensors[model.sensor_names.index(name)] if group == "R" and name in model.sensor_names else None
    if sensor is None or given.shape != (len(sensor.rows),):
        wanted = "one number" if sensor is None else f"one number, or {len(sensor.rows)}: a variance for each row"
        raise ConfigError(f"{group}[{name!r}] has shape {given.shape}; it must be {wanted}")
    start = model.row_start[model.sensor_names.index(name)]
    return [(f"R.{model.row_names[start + k]}", float(number)) for k, number in enumerate(given)]


@dataclass(frozen=True)
class Estimates:
    """One row an event of the log, in its order; `track` has all columns, `events` what was folded."""

    estimator: str
    model: StateSpaceModel
    tuning: Tuning = field(repr=False)
    events: Events = field(repr=False)
    track: Track = field(repr=False)
    covariance: bool = False

    def __len__(self) -> int:
        """Number of events."""
        return len(self.track)

    @cached_property
    def seconds(self) -> np.ndarray:
        """Times of the events, s, (N,)."""
        seconds: np.ndarray = self.events.t * 1e-9
        return seconds

    @property
    def mean(self) -> np.ndarray:
        """Estimates of the states after each event, (N, nx), in their units."""
        mean: np.ndarray = self.track.mean
        return mean

    @property
    def std(self) -> np.ndarray:
        """Their standard deviations, (N, nx)."""
        std: np.ndarray = self.track.std
        return std

    @property
    def nis(self) -> np.ndarray:
        """Normalised innovation squared of each reading, (N,); NaN for other events."""
        nis: np.ndarray = self.track.nis
        return nis

    @property
    def cov(self) -> np.ndarray:
        """Covariances after each event, (N, nx, nx).

        Raises:
            EstimatorError: If the fold did not keep them.
        """
        if not self.covariance:
            raise EstimatorError("the covariances were not kept; fold with covariance=True")
        n = self.model.nx
        cov = np.empty((len(self), n, n))
        cov[:, range(n), range(n)] = self.track.std**2
        i, j = np.triu_indices(n, 1)
        cov[:, i, j] = cov[:, j, i] = self.track.cross
        return cov

    @property
    def log_likelihood(self) -> float:
        """Sum over the readings that were used or refused; see diagnostics/refusals.py."""
        return self.score().log_likelihood

    def readings(self, sensor: str) -> np.ndarray:
        """Indices of the rows that are readings of a sensor.

        Raises:
            EstimatorError: If there is no such sensor.
        """
        if sensor not in self.model.sensor_names:
            raise EstimatorError(
                f"{self.model.name} has no sensor {sensor!r}; it has {', '.join(self.model.sensor_names)}"
            )
        channel = self.model.sensor_names.index(sensor)
        return np.flatnonzero((self.events.kind == READING) & (self.events.channel == channel))

    def table(self) -> Any:
        """A pyarrow.Table, one row an event; `.to_pandas()` makes a frame of it. See tabular.py for its columns."""
        return table_of(self.model, self.events, self.track, self.episodes())

    def episodes(self) -> list[Episode]:
        """What was wrong from when to when, with whom, by how much, and what to do: see docs/alarms.md."""
        marginal = find_estimator(self.estimator, self.model).family in ("particle", "ensemble")
        course = Course(self.model, self.tuning, marginal, self.events, self.track)
        return [found.episode for found in found_in(course)]

    def score(self) -> Score:
        """NIS and its bounds, errors against the truth, predictions of sensors held out."""
        return score(self.track, self.events, self.model, gate=self.tuning.gate, baseline=self.tuning.baseline)

    def nees(self) -> Nees:
        """Normalised estimation error squared wherever the truth is known.

        Raises:
            EstimatorError: If the fold did not keep the covariances, or no truth is known.
        """
        return nees(self.model, self.events, self.mean, self.cov)
