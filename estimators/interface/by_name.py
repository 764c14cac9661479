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
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pickle import PicklingError
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..compiled.black_box import pool_of
from ..diagnostics.consistency import Nees, nees
from ..diagnostics.episodes import Episode, JudgedRows, episodes_of
from ..diagnostics.health import HealthPolicy
from ..diagnostics.score import Score, score
from ..errors import ConfigError, EstimatorError
from ..fold import Fold, folded
from ..fold import fold as fold_track
from ..log import Events, Log
from ..model.state_space import StateSpaceModel
from ..registry import checked, find_estimator
from ..smoothing.smooth import check_smooth, smooth
from ..track import Track, covariances
from ..tuning import Tuning
from .table import table_of

__all__ = ["fold", "fold_many"]

NO_COVARIANCES = "the covariances were not kept; fold with covariance=True"

Prior = tuple[np.ndarray, np.ndarray]
Values = Mapping[str, ArrayLike]


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
        model: Model of the log.
        log: Measurements, inputs, true states.
        R: Variances of sensor noise, in the rows' units squared: by sensor (one number, or one per row), or by row,
            "gnss.east".
        Q: Variances that the process noises add per second, by name.
        p: Parameters by name.
        held_out: Sensors that are predicted and scored, never used.
        gate: Probability that a good measurement passes, such as 0.997; None for no gate.
        seed: Seed of the filter's random numbers.
        prior: Mean (nx,) and covariance (nx, nx), positive semidefinite, in place of the model's; a row of zeros is a
            state that is known exactly.
        covariance: Keep the full covariance at every event, for `Estimates.cov` and `Estimates.nees`.
        smoothed: Return mean, deviations and covariances of the states given all measurements, later ones included;
            innovations, verdicts and health remain the filter's.
        policy: Thresholds of health.
        tuning: Tuning that the arguments above change; None for the one that the model declares.
        **options: Options of the estimator by name; a choice by its word, `resampling="stratified"`.

    Returns:
        The estimates, one row per event.

    Raises:
        EstimatorError: If the estimator does not exist, does not apply or cannot be smoothed, or an option or the prior
            is invalid.
        ConfigError: If a name is unknown or a value is out of range.
        EventError: If the log is of another model.
        ModelError: If the model's functions contradict its declaration, or those of a black box fail.
    """
    tuned = tuned_by_name(estimator, model, tuning, R, Q, p, held_out, gate, seed, options)
    _check_named(log, model)
    pairs = all_pairs(model) if covariance else None
    if smoothed:
        check_smooth(find_estimator(estimator, model), model, tuned.options)
        whole = folded(estimator, model, tuned, log, pairs=pairs, policy=policy, prior=prior)
        track = smooth(whole).instead_of(whole.track)
    else:
        track = fold_track(estimator, model, tuned, log, pairs=pairs, policy=policy, prior=prior)
    return Estimates(estimator, model, tuned, log.events.copy(), track, covariance)


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
        estimator: As in `fold`, and so are R, Q, p, held_out, gate, prior, covariance, policy, tuning and options.
        model: Model of the logs.
        log: One log, or several.
        seeds: Seeds; each log is folded with each.
        executor: "threads" (compiled code releases the GIL), "processes" (for FilterPy's filters and black boxes; `f`
            and `h` must be module-level functions), any concurrent.futures.Executor, or None to fold one after the
            other. The results are the same bits.
        R: See `fold`.
        Q: See `fold`.
        p: See `fold`.
        held_out: See `fold`.
        gate: See `fold`.
        prior: See `fold`.
        covariance: See `fold`.
        policy: See `fold`.
        tuning: See `fold`.
        **options: See `fold`.

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
        # Compile, and check the arguments, before work is submitted.
        Fold(estimator, model, first, each, pairs=pairs, policy=policy, prior=prior)
    kept: dict[str, Any] = {"pairs": pairs, "policy": policy, "prior": prior}
    with _pool(executor) as pool:
        if pool is None:
            tracks = [fold_track(estimator, model, tuned, each, **kept) for each, tuned in jobs]
        else:
            try:
                futures = [pool.submit(fold_track, estimator, model, tuned, each, **kept) for each, tuned in jobs]
                tracks = [future.result() for future in futures]
            except (PicklingError, AttributeError, TypeError) as error:
                if "pickle" not in str(error):
                    raise
                raise EstimatorError(
                    f"fold_many: processes cannot be given {model.name} ({error}); define its functions in a "
                    'module, or use executor="threads"'
                ) from None
    copies = {id(each): each.events.copy() for each in logs}
    return [
        Estimates(estimator, model, tuned, copies[id(each)], track, covariance)
        for (each, tuned), track in zip(jobs, tracks, strict=True)
    ]


def _pool(executor: Executor | str | None) -> AbstractContextManager[Executor | None]:
    """Return a context manager for an executor, which it shuts down if it created it; or for None."""
    if executor is None or isinstance(executor, Executor):
        return nullcontext(executor)
    if executor in ("threads", "processes"):
        return pool_of(executor)
    raise EstimatorError(
        f"fold_many: executor is {executor!r}; it must be 'threads', 'processes', None or a concurrent.futures.Executor"
    )


def _check_named(log: Log, model: StateSpaceModel) -> None:
    """Check that the log's sensors and inputs are the model's; the states may differ.

    Raises:
        EstimatorError: If the sensors or inputs differ.
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


def all_pairs(model: StateSpaceModel) -> np.ndarray:
    """Return every pair of estimated states i < j, (n (n - 1) / 2, 2); considered ones come after these."""
    n = model.nx - model.considered
    if len(model.shown) < n:
        raise EstimatorError(f"covariance: {model.name} has {n:,} states, of which a track keeps some; leave it out")
    return np.stack(np.triu_indices(n, 1), axis=1)


def _seeded(tuning: Tuning, seed: int) -> Tuning:
    # Random numbers depend on the 64 bits of the seed, to which a float or a negative number would be converted.
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
    """Return a tuning with entries given by name.

    Raises:
        NisusError: If a name is unknown or a value is out of range.
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


def _entries(group: str, name: str, value: ArrayLike, model: StateSpaceModel) -> list[tuple[str, float]]:
    """Return keys of a tuning and their values; a sensor with several rows takes one value or one per row."""
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
    """Estimates of a fold, one row per event of the log: `track` has all columns, `events` the folded events."""

    estimator: str
    model: StateSpaceModel
    tuning: Tuning = field(repr=False)
    events: Events = field(repr=False)
    track: Track = field(repr=False)
    covariance: bool = False

    def __len__(self) -> int:
        """Return the number of events."""
        return len(self.track)

    @cached_property
    def seconds(self) -> np.ndarray:
        """Times of the events, s, (N,)."""
        return np.asarray(self.events.t * 1e-9)

    @property
    def mean(self) -> np.ndarray:
        """Estimates of the states after each event, (N, nx), in their units."""
        return np.asarray(self.track.mean)

    @property
    def std(self) -> np.ndarray:
        """Standard deviations of the estimates, (N, nx)."""
        return np.asarray(self.track.std)

    @property
    def nis(self) -> np.ndarray:
        """Normalised innovation squared of each measurement, (N,); NaN for other events."""
        return np.asarray(self.track.nis)

    @property
    def cov(self) -> np.ndarray:
        """Covariances of the estimated states after each event, (N, n, n), in the order of `mean`.

        Raises:
            EstimatorError: If the fold did not keep them.
        """
        if not self.covariance:
            raise EstimatorError(NO_COVARIANCES)
        return covariances(self.track.std, self.track.cross)

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the measurements that were used or rejected; see `Score.log_likelihood`."""
        return self.score().log_likelihood

    def readings(self, sensor: str) -> np.ndarray:
        """Return the indices of the rows with measurements of a sensor.

        Raises:
            EstimatorError: If there is no such sensor.
        """
        if sensor not in self.model.sensor_names:
            raise EstimatorError(
                f"{self.model.name} has no sensor {sensor!r}; it has {', '.join(self.model.sensor_names)}"
            )
        return self.events.of_sensor(self.model.sensor_names.index(sensor))

    def table(self) -> Any:
        """Return a pyarrow.Table, one row per event, for `.to_pandas()`; `table_of` lists the columns."""
        return table_of(self.model, self.events, self.track, self.episodes())

    def episodes(self) -> list[Episode]:
        """Return the episodes of alarms with cause, size and remedy: see docs/alarms.md."""
        marginal = find_estimator(self.estimator, self.model).marginal
        return episodes_of(JudgedRows(self.model, self.tuning, marginal, self.events, self.track))

    def score(self) -> Score:
        """Return NIS and its bounds, errors against the truth, and predictions of held-out sensors."""
        return score(self.track, self.events, self.model, gate=self.tuning.gate, baseline=self.tuning.baseline)

    def plot(self, title: str = "") -> Any:
        """Return a `matplotlib.figure.Figure` of states with ± 2 σ, innovations and NIS; `.savefig(path)` writes it.

        Raises:
            ConfigError: If Matplotlib, or the extension that draws, is not installed.
        """
        # By name, as pandas loads its plotting backend: the numerics depend neither on the application nor Matplotlib.
        draw = import_module("config.extensions").maker("pictures", "track", "track.plot()", "plot")()
        heading = title or f"{self.model.name}, {self.estimator}"
        return draw(self.model, self.events, self.track, episodes=self.episodes(), title=heading)

    def nees(self) -> Nees:
        """Return the normalised estimation error squared at all events with a known truth.

        Raises:
            EstimatorError: If the fold did not keep the covariances, or no truth is known.
        """
        if not self.covariance:
            raise EstimatorError(NO_COVARIANCES)
        return nees(self.model, self.events, self.track, all_pairs(self.model))
