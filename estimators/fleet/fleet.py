"""Many assets of one model, each with its own fold; one compiled call folds all new measurements on all cores.

Each asset's estimate, verdicts, detectors and health are the bits of a `Fold` over its own log. No history is kept:
only the last estimate, two snapshots and the most recent events of each asset, into which late events are inserted; and
of an asset with a rejected sensor the events since the first rejection, for decisions on the sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike

from ..diagnostics.health import NORMALS, HealthPolicy
from ..errors import EstimatorError, EventError, nearest, quoted
from ..events import arrays
from ..events.batch import INPUT, READING, TICK, Events
from ..fold_checks import check_pairs, check_prior, check_soft, check_tuning
from ..fold_machine import Machine, Moments, scratch
from ..gate.isolation import Decision
from ..log import _RANK
from ..model.state_space import LARGE, StateSpaceModel
from ..numerics.jit import threaded
from ..numerics.workspace import WORD, ArrayLayout, view
from ..registry import find_estimator
from ..snapshots import Base, Snapshot
from ..track import Track
from ..tuning import Tuning
from .gate import FleetGates
from .kernel import ASKED_FLAG, CREW, PLAN, REWOUND_FLAG, ROWS, begin_assets, fold_assets
from .memory import (
    AGE,
    CONSISTENCY,
    FLAGS,
    HEALTH,
    NIS_HIGH,
    NIS_LOW,
    NIS_MEAN,
    PHASE,
    SINCE,
    STALE_EVENTS,
    VERDICT,
    N,
    T,
    block_at,
    state_at,
)
from .order import arrange
from .record import record_sizes
from .siblings import siblings
from .table import FleetTable, causes_of
from .tunings import AssetTunings

RECENT = 8
"""Default number of events of an asset among which a late one is always inserted."""

SHARED = 0
"""Index of the context of the shared tuning, or of the first one."""


class Fleet:
    """Folds of many assets that share a model. `add` takes measurements, `advance` folds them, `table` shows all."""

    def __init__(
        self,
        estimator: str,
        model: StateSpaceModel,
        tuning: Tuning | Sequence[Tuning] | None = None,
        *,
        assets: int | Sequence[str],
        values: Mapping[str, ArrayLike] | None = None,
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
            values: Values (assets,) by key of the tuning (`Q.NAME`, `R.NAME`, `p.NAME`), in its units, where assets
                differ from the shared tuning, NaN where they do not; of many assets they take less time and memory than
                tunings of their own.
            start: Time at which the prior holds, s; None for that of an asset's first event.
            policy: Thresholds of health.
            recent: Late events are inserted among the last `recent` events of their asset, and up to twice as many; an
                event before those is dropped and counted as stale. 0 drops every late event, and needs no snapshots,
                which take half of the memory.
            threads: Threads that fold; None for all.
            expected: Sensors that must report, (sensors,) of bool; None for those that have reported.

        Raises:
            EstimatorError: If the estimator does not exist, does not apply or is not Gaussian, a size or a value does
                not fit, or a gate decides on its sensors (`reopen`) and `recent` is 0.
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
        if count < 1 or not 0 <= recent <= 4096:
            raise EstimatorError(
                f"fleet: {count} assets, recent is {recent}; assets must be positive, recent 0 to 4096"
            )
        self.policy, self.recent = (policy or HealthPolicy())._replace(corrections=0), recent
        given = [Tuning.of(model)] if tuning is None else [tuning] if isinstance(tuning, Tuning) else list(tuning)
        if len(given) not in (1, count):
            raise EstimatorError(f"fleet: {len(given)} tunings for {count} assets; give one, or one per asset")
        if values and len(given) > 1:
            raise EstimatorError("fleet: values and a tuning per asset; give one shared tuning, or no values")
        self._expected = expected
        distinct = {id(each): each for each in given}
        self._machines = {k: self._machine(each) for k, each in enumerate(distinct.values())}
        """Machines by context; those of contexts with values of their own are made on demand."""
        places = {key: k for k, key in enumerate(distinct)}
        self._tuning_of = np.zeros(count, np.int32)
        if len(given) > 1:
            self._tuning_of[:] = [places[id(each)] for each in given]
        self._contexts = np.concatenate([np.array([each.context]).view(np.int64) for each in self._machines.values()])
        self._contexts = self._contexts.reshape(len(self._machines), -1)
        self._rules = np.array([each.rule for each in self._machines.values()], np.int64)
        self._valued: list[tuple[int, AssetTunings]] = []
        if values:
            self._add_values(AssetTunings(self._machines[SHARED], values, self.assets))
            self._tuning_of[:] = 1 + np.arange(count)
        self._shared, self._start = given[0], start
        self._allocate(None if start is None else int(arrays.nanoseconds("start", start)[0]))
        self._plan = self._planned(threads)
        self._point()
        self._added: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def _machine(self, tuning: Tuning, prior: Moments | None = None) -> Machine:
        check_tuning(tuning, self.model)
        options = self.estimator.complete_for(self.model, tuning.options)
        if tuning.gate is not None and tuning.reopen is not None and self.recent == 0:
            raise EstimatorError(
                f"fleet: gate.reopen is {tuning.reopen:g} s, and recent is 0; decisions on a rejected sensor need "
                "snapshots: make recent positive, or set gate.reopen to null"
            )
        check_soft(tuning, self.estimator, options)
        pairs = check_pairs(None, self.model)
        return Machine(
            self.estimator, options, self.model, tuning, pairs, self.policy, prior=prior, expected=self._expected
        )

    def _add_values(self, valued: AssetTunings) -> None:
        """Append the contexts of assets with values of their own."""
        count = len(valued.contexts)
        self._valued.append((len(self._contexts), valued))
        self._contexts = np.concatenate([self._contexts, valued.contexts])
        self._rules = np.concatenate([self._rules, np.tile(self._rules[SHARED], (count, 1))])

    def _machine_of(self, asset: int) -> Machine:
        k = int(self._tuning_of[asset])
        if k in self._machines:
            return self._machines[k]
        first, valued = next(each for each in reversed(self._valued) if each[0] <= k)
        return self._machine(valued.tuning(k - first))

    def _allocate(self, start: int | None) -> None:
        """Allocate the blocks of all assets, each before its first event."""
        model = self.model
        machine = self._machines[SHARED]
        one = machine.fresh()
        self._state_sizes = (model.nu, one.state.size, one.evidence.size, one.edge.size, len(model.sensors))
        self._state = state_at(0, *self._state_sizes)
        size = self._state.end // WORD
        self._columns = max(1, model.ny, model.nu)
        kept, ring, slots = self.policy.window + max(1, 2 * self.recent), 2 * self.recent + 1, 2 if self.recent else 0
        self._block = block_at(0, size, kept, ring, slots, self._columns, len(model.shown))
        # Whole cache lines, so that two threads never write to the same one.
        words = -(-self._block.end // (8 * WORD)) * 8
        self._sizes = {"size": size, "kept": kept, "slots": slots, "stride": WORD * words, "hot": self._block.codes.at}
        self._memory = np.zeros((len(self.assets), words))
        self._part(self._block.head).view(np.int64)[:, PHASE] = np.arange(len(self.assets)) % max(1, self.recent)
        self._part(self._block.mean)[:] = np.nan
        self._part(self._block.std)[:] = np.nan
        states = self._begun(slice(None), machine.prior, start)
        self._part(self._block.now)[:] = states[0] if len(states) == 1 else states[self._tuning_of]

    def _begun(self, contexts: slice, prior: Moments, start: int | None) -> np.ndarray:
        """Return the numbers of the state before the first event of some contexts, (contexts, numbers)."""
        machine, size = self._machines[SHARED], self._state_sizes[1]
        if any(each.fresh().state.size != size for each in self._machines.values()):
            raise EstimatorError(
                "fleet: options of a tuning change the size of the filter's state; it must be the same"
            )
        fresh, line = machine.fresh(), np.zeros(self._sizes["size"])
        if start is not None:
            fresh.clock[0] = start
        line[: sum(part.size for part in fresh)] = np.concatenate(
            [fresh.clock.view(float), *(part.ravel() for part in fresh[1:])]
        )
        last = self._state.last.at // WORD
        line[last + NIS_MEAN : last + CONSISTENCY], line[last + CONSISTENCY] = np.nan, 1.0
        given = self._contexts[contexts]
        lines, states = np.tile(line, (len(given), 1)), np.empty((len(given), size))
        begin_assets(machine.code, given, *map(np.ascontiguousarray, prior), states)
        at = self._state.filter.at // WORD
        lines[:, at : at + size] = states
        return lines

    def _part(self, part: ArrayLayout, within: int = 0) -> np.ndarray:
        """Return a field of all blocks as a view (assets, numbers)."""
        at = within + part.at // WORD
        return self._memory[:, at : at + int(np.prod(part.shape))]

    def _now(self, part: ArrayLayout) -> np.ndarray:
        return self._part(part, self._block.now.at // WORD)

    @property
    def _head(self) -> np.ndarray:
        return self._part(self._block.head).view(np.int64)

    def _planned(self, threads: int | None) -> np.ndarray:
        """Make the plan of the compiled call, except for its events and what `_point` writes."""
        model, machine, policy = self.model, self._machines[SHARED], self.policy
        most = int(numba.config.NUMBA_NUM_THREADS) if threaded() else 1
        self.threads = min(most, threads or most)
        nu, state, evidence, edge, sensors = self._state_sizes
        kept, ring = self._sizes["kept"], 2 * self.recent + 1
        self._crews = [_crew(model, machine, kept, ring, self._columns, state) for _ in range(self.threads)]
        self._crew_places = np.array([[part.ctypes.data for part in crew] for crew in self._crews], np.int64)
        assert self._crew_places.shape == (self.threads, len(CREW))
        gates = FleetGates(
            len(self.assets), self.threads, self.recent, self._sizes["size"], self._columns, self._snapshot
        ) if self._rules[:, 1].any() else None  # fmt: skip
        self._gates: FleetGates | None = gates
        record_slots, record_rows = record_sizes(max(1, self.recent))
        low, high = machine.bounds
        self._held = low, high
        code = machine.code
        plan = np.zeros(1, PLAN)
        values: dict[str, object] = {
            **self._sizes, **policy._asdict(), **code._asdict(),
            "crews": self.threads, "crew_places": self._crew_places.ctypes.data,
            "free": 0 if gates is None else gates.free.ctypes.data,
            "record_slots": record_slots, "record_rows": record_rows, "nx": len(model.shown), "nu": nu, "state": state,
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

    def positions(self, asset: ArrayLike) -> np.ndarray:
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

    def add(self, sensor: str, asset: ArrayLike, seconds: ArrayLike, values: ArrayLike) -> None:
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

    def add_inputs(self, asset: ArrayLike, seconds: ArrayLike, **inputs: ArrayLike) -> None:
        """Add inputs of any assets; each holds until its next value. See `add` and `Log.add_inputs`."""
        at, seconds = self._pair(asset, seconds)
        self._put(at, arrays.inputs(self.model, seconds, inputs), INPUT)

    def add_events(self, asset: ArrayLike, events: Events) -> None:
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

    def extend(self, assets: int | Sequence[str], values: Mapping[str, ArrayLike] | None = None) -> None:
        """Append assets, each before its first event, with the shared tuning, or that of the first one.

        Args:
            assets: Names of the assets; or their number, if the fleet's are numbers.
            values: Values of their own, by key of the tuning.

        Raises:
            EstimatorError: If a value does not fit.
        """
        more = Fleet(
            self.estimator.name, self.model, self._shared, assets=assets, values=values, start=self._start,
            policy=self.policy, recent=self.recent, threads=1, expected=self._expected,
        )  # fmt: skip
        before = self.assets
        count = len(before) + len(more.assets)
        self.assets = range(count) if isinstance(before, range) else [*before, *more.assets]
        self._index = None
        more._head[:, PHASE] = np.arange(len(before), count) % max(1, self.recent)
        self._memory = np.concatenate([self._memory, more._memory])
        tuning_of = more._tuning_of
        for _, valued in more._valued:
            tuning_of = tuning_of + np.int32(len(self._contexts) - 1)
            self._add_values(valued)
        self._tuning_of = np.concatenate([self._tuning_of, tuning_of])
        if self._gates is not None:
            self._gates.extend(len(more.assets))
        self._point()

    def sibling_prior(self, *states: str) -> Moments:
        """Return the model's prior with mean and spread of some states over the assets: the prior of a new asset.

        The spread is that of the true values, without the errors of the estimates (empirical Bayes, see `siblings`).

        Args:
            states: Names of states that are constant or alike in all assets, such as an estimated parameter or a bias.

        Raises:
            EstimatorError: If there is no such state, or fewer than 8 assets have an estimate.
        """
        mean, cov = (part.copy() for part in self._machines[SHARED].prior)
        shown = [state.name for state in self.model.shown_states]
        for name in states:
            if name not in shown:
                raise EstimatorError(f"fleet: {self.model.name} has no state {quoted(name)}; {nearest(name, shown)}")
            k, j = shown.index(name), self.model.state_names.index(name)
            seen = self._head[:, N] > 0
            found = siblings(self._part(self._block.mean)[seen, k], self._part(self._block.std)[seen, k])
            mean[j] = found.mean
            cov[j, :] = cov[:, j] = 0.0
            cov[j, j] = found.std**2
        return mean, cov

    def set_prior(self, asset: ArrayLike, prior: Moments) -> None:
        """Give assets that have no events yet another prior, such as that of `sibling_prior`.

        Args:
            asset: Names or positions of the assets, (N,) or one.
            prior: Mean (nx,) and covariance (nx, nx), in place of the model's.

        Raises:
            EventError: If there is no such asset.
            EstimatorError: If an asset has events, or the prior does not fit the model.
        """
        at = self.positions(asset)
        given = check_prior(prior, self.model, self.estimator)
        if np.any(seen := self._head[at, N] > 0):
            name = self.assets[int(at[np.argmax(seen)])]
            raise EstimatorError(f"fleet: asset {name} has events; a prior can only be given before the first")
        start = None if self._start is None else int(arrays.nanoseconds("start", self._start)[0])
        for k in np.unique(self._tuning_of[at]).tolist():
            mine = at[self._tuning_of[at] == k]
            machine = self._machine(self._machine_of(int(mine[0])).tuning, given)
            new = len(self._contexts)
            self._machines[new] = machine
            self._contexts = np.concatenate([self._contexts, np.array([machine.context]).view(np.int64)[None]])
            self._rules = np.concatenate([self._rules, [machine.rule]])
            self._tuning_of[mine] = new
            self._part(self._block.now)[mine] = self._begun(slice(new, None), given, start)
        self._point()

    def _point(self) -> None:
        """Write the addresses of arrays that may have moved into the plan."""
        self._address(
            memory=self._memory, tunings=self._tuning_of, contexts=self._contexts, rules=self._rules
        )  # fmt: skip
        if self._gates is not None:
            self._address(records=self._gates.places)

    def _address(self, **columns: np.ndarray) -> None:
        for name, column in columns.items():
            self._plan[name] = column.ctypes.data

    def add_ticks(self, seconds: ArrayLike, asset: ArrayLike | None = None) -> None:
        """Add queries, of all assets by default: the estimate and health of silent assets become those of that time."""
        at, seconds = self._pair(np.arange(len(self.assets)) if asset is None else asset, seconds)
        self._put(at, arrays.ticks(self.model.width, seconds), TICK)

    def _pair(self, asset: ArrayLike, seconds: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        at, given = self.positions(asset), np.asarray(seconds)
        size = at.size if given.ndim == 0 else given.size
        if given.ndim == 0 and size > 1:
            given = np.full(size, seconds)
        if at.size == 1 and size > 1:
            at = np.full(size, at[0])
        if at.size != size:
            raise EventError(f"{at.size} assets for {size} times; give one asset per time")
        return at, given

    def _put(self, at: np.ndarray, batch: Events, kind: int) -> None:
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
        numbers = np.empty((4, t.size + 1), np.int64)
        order, spare, visited, starts = numbers
        scratch_of_assets = np.empty(len(self.assets), np.int64)
        found = arrange(asset, t, place, value, scratch_of_assets, order, spare, visited, starts)
        self._address(order=order, t=t, place=place, value=value)
        self._plan["events"] = t.size
        visited, begins, ends = visited[:found], starts[:found].copy(), starts[1 : found + 1].copy()
        while visited.size:
            unfinished, asked = np.ones(visited.size, np.int8), np.zeros(visited.size, np.int8)
            self._address(visited=visited, begins=begins, ends=ends, unfinished=unfinished, asked=asked)
            self._plan["count"] = visited.size
            if self._gates is not None:
                self._gates.refill()
            fold_assets(self._plan.ctypes.data, self.threads)
            if self._gates is None:
                break
            for v in np.flatnonzero(asked).tolist():
                self._decide(int(visited[v]), int(asked[v]))
            left = np.flatnonzero(unfinished)
            visited, begins, ends = visited[left], begins[left], ends[left]
        return int(t.size)

    def _decide(self, asset: int, asked: int) -> None:
        """Decide on the sensor of an asset where the compiled loop stopped for it."""
        assert self._gates is not None
        if asked & REWOUND_FLAG:
            self._gates.rewound(asset)
        if asked & ASKED_FLAG:
            state = self._part(self._block.now)[asset]
            self._gates.decide(asset, self._head[asset], state, self._machine_of(asset))

    def _snapshot(self, state: np.ndarray) -> Snapshot:
        """Return the numbers of a state as a snapshot, as views."""
        clock, *rest = (view(part, state) for part in self._state[:6])
        return Snapshot(clock.view(np.int64), *rest)

    def decisions(self, asset: ArrayLike) -> list[Decision]:
        """Return the latest decisions on rejected sensors of an asset; see `Fold.decisions`.

        Raises:
            EventError: If there is no such asset.
        """
        at = int(self.positions(asset)[0])
        return [] if self._gates is None else self._gates.decisions(at)

    @property
    def stale(self) -> np.ndarray:
        """View of the events of each asset that were dropped as too late, shape (assets,)."""
        return self._head[:, STALE_EVENTS]

    def table(self) -> FleetTable:
        """Return the state of all assets as of their last event."""
        head = self._head
        last = self._now(self._state.last)
        seen = head[:, N] > 0
        t, since = np.ascontiguousarray(last[:, [T, SINCE]].T).view(np.int64) * 1e-9
        return FleetTable(
            self.assets,
            np.where(seen, t, np.nan),
            np.where(seen, since, np.nan),
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
        first, last, _ = part.indices(len(self.assets))
        records = [] if self._gates is None else self._gates.state(first, last)
        return b"".join([np.int64(last - first).tobytes(), self._memory[first:last].tobytes(), *records])

    def restore(self, first: int, state: bytes) -> None:
        """Take over the `state` of assets of another fleet of this model, estimator and tuning, from a position on.

        Raises:
            EstimatorError: If it is not of such a fleet, or of more assets than there are.
        """
        words = self._memory.shape[1]
        count = int(np.frombuffer(state[:WORD], np.int64)[0]) if len(state) >= WORD else -1
        end = WORD * (1 + count * words)
        fits = count >= 0 and first + count <= len(self.assets) and end <= len(state)
        if fits and self._gates is not None:
            fits = self._gates.restore(first, count, state[end:])
        elif len(state) != end:
            fits = False
        if not fits:
            raise EstimatorError(f"fleet: {len(state)} bytes are no state of assets of {WORD * words} bytes each")
        self._memory[first : first + count] = np.frombuffer(state[WORD:end]).reshape(count, words)

    def base(self, asset: str | int) -> Base:
        """Return the state of one asset, from which a `Fold` of its own continues; it begins with an empty NIS window.

        Raises:
            EventError: If there is no such asset.
        """
        a = int(self.positions(asset)[0])
        now = self._snapshot(self._part(self._block.now)[a]).copy()
        mean, cov = self._machines[SHARED].moments(now.state)
        return Base(
            mean, cov, int(now.clock[0]), now.u, self.estimator.name, now.state, int(self._head[a, N]),
            evidence=now.evidence, edge=now.edge, doubt=now.doubt,
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
