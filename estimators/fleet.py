"""Many assets of one model, each with its own fold; one compiled call folds all new measurements on all cores.

Each asset's estimate, verdicts, detectors and health are the bits of a `Fold` over its own log. No history is kept:
only the last estimate, two snapshots and the most recent events of each asset, into which late events are inserted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np

from .diagnostics.health import NORMALS, HealthPolicy
from .errors import EstimatorError, EventError, nearest, quoted
from .events import arrays
from .events.batch import INPUT, READING, TICK, Events
from .fleet_kernel import (
    AGE,
    CREW,
    NIS_HIGH,
    NIS_LOW,
    NIS_MEAN,
    PLAN,
    ROWS,
    T,
    block_at,
    fold_assets,
    in_asset_order,
    state_at,
)
from .fleet_table import FleetTable, causes_of
from .fleet_window import FLAGS, HEALTH, STALE_EVENTS, VERDICT, N
from .fold_checks import check_pairs, check_soft, check_tuning
from .fold_machine import Machine, scratch
from .log import _RANK
from .model.state_space import LARGE, StateSpaceModel
from .numerics.jit import threaded
from .numerics.workspace import WORD
from .registry import find_estimator
from .snapshots import Base
from .track import Track
from .tuning import Tuning

RECENT = 8
"""Default number of events of an asset among which a late one is always inserted."""


class Fleet:
    """Folds of many assets that share a model. `add` takes measurements, `advance` folds them, `table` shows all."""

    def __init__(
        self,
        estimator: str,
        model: StateSpaceModel,
        tuning: Tuning | Sequence[Tuning] | None = None,
        *,
        assets: int | Sequence[str],
        start: float | None = None,
        policy: HealthPolicy | None = None,
        recent: int = RECENT,
        threads: int | None = None,
        expected: np.ndarray | None = None,
    ) -> None:
        """Allocate the memory of all assets.

        Args:
            estimator: Name in the registry, of the Gaussian family.
            model: Model of all assets; compiled on first use.
            tuning: One for all assets, or one per asset (assets may share the same object); None for the model's.
            assets: Names of the assets, or their number.
            start: Time at which the prior holds, s; None for that of an asset's first event.
            policy: Thresholds of health.
            recent: Late events are inserted among the last `recent` events of their asset, and up to twice as many; an
                event before those is dropped and counted as stale.
            threads: Threads that fold; None for all.
            expected: Sensors that must report, (sensors,) of bool; None for those that have reported.

        Raises:
            EstimatorError: If the estimator does not exist, does not apply or is not Gaussian, a size does not fit, or
                a gate decides on its sensors (`reopen`), for which an asset's history would be needed.
            EventError: If `start` is not finite or beyond ±146 years.
        """
        self.estimator, self.model = find_estimator(estimator, model), model
        if self.estimator.family != "Gaussian" or self.estimator.interpreted or model.black_box or model.nx > LARGE:
            raise EstimatorError(
                f"fleet: estimator {estimator} of {model.name}; a fleet needs a compiled model of at most {LARGE} "
                "states and a Gaussian filter, such as kf, ekf or ukf"
            )
        self.assets: Sequence[Any] = range(assets) if isinstance(assets, int) else list(assets)
        self._index: dict[str, int] | None = None
        count = len(self.assets)
        if count < 1 or not 1 <= recent <= 4096:
            raise EstimatorError(f"fleet: {count} assets, recent is {recent}; both must be positive, recent up to 4096")
        self.policy, self.recent = policy or HealthPolicy(), recent
        given = [Tuning.of(model)] if tuning is None else [tuning] if isinstance(tuning, Tuning) else list(tuning)
        if len(given) not in (1, count):
            raise EstimatorError(f"fleet: {len(given)} tunings for {count} assets; give one, or one per asset")
        distinct = {id(each): each for each in given}
        self._expected = expected
        self._machines = [self._machine(each) for each in distinct.values()]
        places = {key: k for k, key in enumerate(distinct)}
        self._tuning_of = np.zeros(count, np.int32)
        if len(given) > 1:
            self._tuning_of[:] = [places[id(each)] for each in given]
        self._first = given[0], start
        self._allocate(None if start is None else int(arrays.nanoseconds("start", start)[0]))
        self._plan = self._planned(threads)
        self._added: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def _machine(self, tuning: Tuning) -> Machine:
        check_tuning(tuning, self.model)
        options = self.estimator.complete_for(self.model, tuning.options)
        if tuning.gate is not None and tuning.reopen is not None:
            raise EstimatorError(
                f"fleet: gate.reopen is {tuning.reopen:g} s; a fleet keeps no history from which to decide on a "
                "rejected sensor: set gate.reopen to null"
            )
        if tuning.gate is not None and tuning.gate_kind == "soft":
            check_soft(self.estimator, options)
        pairs = check_pairs(None, self.model)
        return Machine(
            self.estimator, options, self.model, tuning, pairs, self.policy, prior=None, expected=self._expected
        )

    def _allocate(self, start: int | None) -> None:
        """Allocate the blocks of all assets, each before its first event."""
        model = self.model
        fresh = [each.fresh() for each in self._machines]
        for each, snapshot in zip(self._machines, fresh, strict=True):
            each.begin(*each.prior, snapshot.state)
            if start is not None:
                snapshot.clock[0] = start
        one = fresh[0]
        self._state_sizes = (model.nu, one.state.size, one.evidence.size, one.edge.size, len(model.sensors))
        self._state = state_at(0, *self._state_sizes)
        size = self._state.end // WORD
        self._columns = max(1, model.ny, model.nu)
        kept = self.policy.window + 2 * self.recent
        self._block = block_at(0, size, kept, 2 * self.recent + 1, self._columns, len(model.shown))
        # Whole cache lines, so that two threads never write to the same one.
        words = -(-self._block.end // (8 * WORD)) * 8
        self._sizes = {"size": size, "kept": kept, "stride": WORD * words}
        self._memory = np.zeros((len(self.assets), words))
        states = np.zeros((len(fresh), size))
        for line, snapshot in zip(states, fresh, strict=True):
            line[: sum(part.size for part in snapshot)] = np.concatenate(
                [snapshot.clock.view(float), *(part.ravel() for part in snapshot[1:])]
            )
            last = self._state.last.at // WORD
            line[last + 2 : last + 5], line[last + 5] = np.nan, 1.0
        own = self._part(self._block.now)
        own[:] = states[0] if len(states) == 1 else states[self._tuning_of]
        self._part(self._block.mean)[:] = np.nan
        self._part(self._block.std)[:] = np.nan

    def _part(self, part: Any, within: int = 0) -> np.ndarray:
        """Return a field of all blocks as a view (assets, numbers)."""
        at = within + part.at // WORD
        return self._memory[:, at : at + int(np.prod(part.shape))]

    def _now(self, part: Any) -> np.ndarray:
        return self._part(part, self._block.now.at // WORD)

    @property
    def _head(self) -> np.ndarray:
        return self._part(self._block.head).view(np.int64)

    def _planned(self, threads: int | None) -> np.ndarray:
        """Make the plan of the compiled call, except for its events."""
        model, machine, policy = self.model, self._machines[0], self.policy
        most = int(numba.config.NUMBA_NUM_THREADS) if threaded() else 1
        self.threads = min(most, threads or most)
        nu, state, evidence, edge, sensors = self._state_sizes
        kept, ring = self._sizes["kept"], 2 * self.recent + 1
        self._crews = [_crew(model, machine, kept, ring, self._columns, state) for _ in range(self.threads)]
        self._crew_places = np.array([[part.ctypes.data for part in crew] for crew in self._crews], np.int64)
        assert self._crew_places.shape == (self.threads, len(CREW))
        self._contexts = np.array([each.context for each in self._machines])
        low, high = machine.bounds
        self._held = low, high
        code = machine.code
        plan = np.zeros(1, PLAN)
        values: dict[str, Any] = {
            **self._sizes, **policy._asdict(), **code._asdict(),
            "memory": self._memory.ctypes.data, "tunings": self._tuning_of.ctypes.data,
            "contexts": self._contexts.ctypes.data, "crews": self.threads, "crew_places": self._crew_places.ctypes.data,
            "soft": machine.rule.soft, "nx": len(model.shown), "nu": nu, "state": state,
            "evidence": evidence, "edge": edge, "sensors": sensors, "rows": len(model.row_names), "ny": model.ny,
            "width": model.width, "work": machine.work.size,
            "recent": self.recent, "columns": self._columns, "low": low.ctypes.data,
            "high": high.ctypes.data, "quantiles": low.size,
        }  # fmt: skip
        for name, value in values.items():
            plan[name] = value
        return plan

    @property
    def nbytes(self) -> int:
        """Bytes of all assets."""
        return self._memory.nbytes

    def positions(self, asset: Any) -> np.ndarray:
        """Return the positions of assets (N,), given as names or as positions.

        Raises:
            EventError: If there is no such asset.
        """
        given = np.atleast_1d(np.asarray(asset))
        if given.dtype.kind in "iu":
            at = given.astype(np.int64)
            if at.size and (at.min() < 0 or at.max() >= len(self.assets)):
                wrong = int(at.min() if at.min() < 0 else at.max())
                raise EventError(f"asset is {wrong}; the fleet has assets 0 to {len(self.assets) - 1}")
            return at
        if self._index is None:
            self._index = {name: k for k, name in enumerate(self.assets)}
        try:
            return np.array([self._index[name] for name in given.tolist()], np.int64)
        except KeyError as error:
            name = error.args[0]
            known = [str(each) for each in self.assets[:1000]]
            raise EventError(f"the fleet has no asset {quoted(str(name))}; {nearest(str(name), known)}") from None

    def add(self, sensor: str, asset: Any, seconds: Any, values: Any) -> None:
        """Add measurements of one sensor of any assets, in any order; `advance` folds them.

        Args:
            sensor: Name of the sensor in the model.
            asset: Names or positions of the assets, (N,) or one.
            seconds: Times of measurement, s, (N,) or one number.
            values: Values in the units of the sensor's rows, (N,) or (N, rows); NaN is missing.

        Raises:
            EventError: If a name or a shape does not fit.
        """
        at, seconds = self._pair(asset, seconds)
        self._put(at, arrays.readings(self.model, sensor, seconds, values), READING)

    def add_inputs(self, asset: Any, seconds: Any, **inputs: Any) -> None:
        """Add inputs of any assets; each holds until its next value. See `add` and `Log.add_inputs`."""
        at, seconds = self._pair(asset, seconds)
        self._put(at, arrays.inputs(self.model, seconds, inputs), INPUT)

    def add_events(self, asset: Any, events: Events) -> None:
        """Add the events of a source, each of its asset; others than measurements, inputs and queries are left out.

        Args:
            asset: Names or positions of the assets, (N,).
            events: N events; times are ns.

        Raises:
            EventError: If there is no such asset.
        """
        at, kept = self.positions(asset), np.isin(events.kind, (READING, INPUT, TICK))
        events = events.select(kept)
        self._added.append((at[kept], events.t, _RANK[events.kind] + events.channel, events.value[:, : self._columns]))

    def extend(self, assets: int | Sequence[str]) -> None:
        """Append assets, each before its first event, with the tuning of the first one.

        Args:
            assets: Names of the assets; or their number, if the fleet's are numbers.
        """
        tuning, start = self._first
        more = Fleet(
            self.estimator.name, self.model, tuning, assets=assets, start=start, policy=self.policy,
            recent=self.recent, threads=1, expected=self._expected,
        )  # fmt: skip
        before = self.assets
        count = len(before) + len(more.assets)
        self.assets = range(count) if isinstance(before, range) else [*before, *more.assets]
        self._index = None
        self._memory = np.concatenate([self._memory, more._memory])
        self._tuning_of = np.concatenate([self._tuning_of, more._tuning_of])
        self._plan["memory"], self._plan["tunings"] = self._memory.ctypes.data, self._tuning_of.ctypes.data

    def add_ticks(self, seconds: Any, asset: Any = None) -> None:
        """Add queries, of all assets by default: the estimate and health of silent assets become those of that time."""
        at, seconds = self._pair(np.arange(len(self.assets)) if asset is None else asset, seconds)
        self._put(at, arrays.ticks(self.model.width, seconds), TICK)

    def _pair(self, asset: Any, seconds: Any) -> tuple[np.ndarray, Any]:
        at, given = self.positions(asset), np.asarray(seconds)
        size = at.size if given.ndim == 0 else given.size
        if given.ndim == 0 and size > 1:
            given = np.full(size, seconds)
        if at.size == 1 and size > 1:
            at = np.full(size, at[0])
        if at.size != size:
            raise EventError(f"{at.size} assets for {size} times; give one asset per time")
        return at, given

    def _put(self, at: np.ndarray, batch: Any, kind: int) -> None:
        self._added.append((at, batch.t, _RANK[kind] + batch.channel, batch.value[:, : self._columns]))

    def advance(self) -> int:
        """Fold all added events, each where it belongs, and return how many.

        Only assets with new events are visited. Events of one call are put in order first, so an event is late only
        relative to those of earlier calls.
        """
        if not self._added:
            return 0
        added, self._added = self._added, []
        columns = added[0] if len(added) == 1 else tuple(np.concatenate(parts) for parts in zip(*added, strict=True))
        asset, t, place, value = (np.ascontiguousarray(column) for column in columns)
        if not len(t):
            return 0
        if not in_asset_order(asset, t, place):
            order = np.lexsort((*value.T[::-1], place, t, asset))
            asset, t, place, value = asset[order], t[order], place[order], value[order]
        starts = np.flatnonzero(np.concatenate(([True], asset[1:] != asset[:-1])))
        visited = asset[starts]
        starts = np.append(starts, t.size)
        given = {"visited": visited, "starts": starts, "t": t, "place": place, "value": value}
        for name, column in given.items():
            self._plan[name] = column.ctypes.data
        self._plan["count"] = visited.size
        fold_assets(self._plan.ctypes.data, self.threads)
        return int(t.size)

    def table(self) -> FleetTable:
        """Return the state of all assets as of their last event."""
        head = self._head
        last = self._now(self._state.last)
        seen = head[:, N] > 0
        t = np.ascontiguousarray(last[:, T]).view(np.int64)
        return FleetTable(
            self.assets,
            np.where(seen, t * 1e-9, np.nan),
            self._part(self._block.mean).copy(),
            self._part(self._block.std).copy(),
            head[:, HEALTH].astype(np.int8),
            causes_of(self.model, self._now(self._state.evidence), head[:, FLAGS], head[:, HEALTH]),
            np.where(seen, last[:, AGE], np.nan),
            head[:, VERDICT].astype(np.int8),
            last[:, NIS_MEAN].copy(),
            last[:, NIS_LOW].copy(),
            last[:, NIS_HIGH].copy(),
            head[:, N].copy(),
            head[:, STALE_EVENTS].copy(),
        )

    def state(self, part: slice) -> bytes:
        """Return the state of some assets by position, for `restore`; events that were not folded yet are not in it."""
        return self._memory[part].tobytes()

    def restore(self, first: int, state: bytes) -> None:
        """Take over the `state` of assets of another fleet of this model, estimator and tuning, from a position on.

        Raises:
            EstimatorError: If it is not of such a fleet, or of more assets than there are.
        """
        words = self._memory.shape[1]
        count, rest = divmod(len(state), WORD * words)
        if rest or first + count > len(self.assets):
            raise EstimatorError(f"fleet: {len(state)} bytes are no state of assets of {WORD * words} bytes each")
        self._memory[first : first + count] = np.frombuffer(state).reshape(count, words)

    def base(self, asset: str | int) -> Base:
        """Return the state of one asset, from which a `Fold` of its own continues; it begins with an empty NIS window.

        Raises:
            EventError: If there is no such asset.
        """
        a = int(self.positions(asset)[0])
        state, machine = self._state, self._machines[self._tuning_of[a]]
        clock, u, own, evidence, edge, doubt = (self._now(part)[a].copy() for part in state[:6])
        mean, cov = machine.moments(own)
        return Base(
            mean, cov, int(clock.view(np.int64)[0]), u, self.estimator.name, own, int(self._head[a, N]),
            evidence=evidence, edge=edge, doubt=doubt.reshape(state.doubt.shape),
        )  # fmt: skip


def _crew(model: StateSpaceModel, machine: Machine, kept: int, ring: int, columns: int, state: int) -> list[np.ndarray]:
    """Allocate the scratch of one thread, in the order of `CREW`."""
    track = Track.allocate(ROWS, len(model.shown), 0, model.ny, model.width)
    return [
        *track,
        np.zeros(machine.context.nbytes // WORD, np.int64),
        np.empty(max(1, len(model.row_names))),
        np.empty(state),
        scratch(machine.work.size),
        machine.score.copy(),
        np.zeros(ROWS, np.int64),
        np.full(ROWS, READING, np.int8),
        np.zeros(ROWS, np.int32),
        np.full((ROWS, columns), np.nan),
        np.empty(columns),
        np.empty(0),
        np.empty((1 + NORMALS, kept)),
        np.zeros(ring, np.int64),
        np.zeros(ring, np.int64),
        np.full((ring, columns), np.nan),
    ]
