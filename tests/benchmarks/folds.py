"""Cost of folds: long histories, refolds, smoothing, defences, and reading a CAN log."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from time import perf_counter
from types import FunctionType
from typing import Any

import numpy as np
from numba.extending import register_jitable

from app.extensions.lab.stress.scenario import plain_log
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
from estimators import fold_kernel
from estimators.errors import SourceError
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.models import MODELS
from estimators.numerics.cache_entries import Linked
from estimators.numerics.jit import jit, jit_brief, plain
from estimators.smoothing.smooth import smooth
from estimators.tuning import Tuning
from sources.can.decoder import Decoder
from sources.can.log import CanLog
from sources.can.mf4 import read_mf4
from sources.can.readers import Raw, read_messages
from sources.source import Channel
from tests.support import as_log

from ..estimators.smoothing.test_textbook import CAR
from ..models import write_plant
from ..skips import data_folder
from ..support import SECOND
from .filters import STEPS, noisy_log
from .timing import BenchmarkRow, Bound, both, medians, seconds

REFOLD_READINGS = 100_000
DEFAULT_TWIN = "motor_can"

SMOOTHED, SHORT = 100_000, 10_000  # Readings that are smoothed, and that the peers smooth

SMOOTHERS = ("kf", "ekf", "iekf", "ukf", "ckf", "sr-kf", "sr-ekf", "sr-ukf")
F = np.kron(np.array([[1.0, 0.1], [0.0, 1.0]]), np.eye(2))
Q = np.kron(np.array([[0.1**3 / 3, 0.1**2 / 2], [0.1**2 / 2, 0.1]]), np.eye(2))
H, R = np.eye(2, 4), 0.25 * np.eye(2)


DEFENDED = (("motor_can", "ekf"), ("motor_can", "ukf"), ("road_car", "ekf"), ("motor_can", "pf"))
PARTICLE_EVENTS = 1000


def again(fold: Fold) -> None:
    """Fold from the start."""
    fold.rewind(0)
    fold.advance()


def growing_history() -> Iterator[BenchmarkRow]:
    """History (KF n=2 m=1): µs per event of the whole fold, of one event appended, of one reading 100 events late."""
    model = MODELS["motor_winding"]
    for size in (1_000, 10_000, 100_000, 1_000_000):
        # Capacity for what is appended: the growth of the arrays is not measured.
        log = Log.of(model, capacity=size + 4096)
        log.extend(noisy_log(model, size).events)
        growing = Fold("kf", model, Tuning.of(model), log)
        growing.advance()

        def add(behind: int, log: Log = log, growing: Fold = growing) -> None:
            t = int(log.t[log.n - behind]) + (1 if behind > 1 else SECOND)
            start, _ = log.extend(Events.one(t, t, READING, 0, 35.0, 1))
            if behind > 1:
                growing.rewind(start)
            growing.advance()

        (whole,) = medians([partial(again, growing)], 5 if size < 1_000_000 else 3)
        one, late = medians([partial(add, 1), partial(add, 100)], 301)
        yield BenchmarkRow(
            f"{size:,} events", {"fold [µs]": whole / size * 1e6, "append [µs]": one * 1e6, "late [µs]": late * 1e6}
        )


def endless_log(twin, readings: int) -> Log:
    """Return a simulated log with so many readings.

    Repeating the twin's recording would jump at each seam, where the gate would weigh two explanations.
    """
    duration = 60.0
    while np.count_nonzero((events := plain_log(twin, 0, duration)).kind == READING) < readings:
        duration *= 2.0
    enough = int(np.searchsorted(np.cumsum(events.kind == READING), readings)) + 1
    log = Log.of(twin.model, capacity=enough)
    log.extend(events.select(slice(0, enough)))
    return log


def refold() -> Iterator[BenchmarkRow]:
    """Refold of 100,000 readings of the default twin after a slider moved, seconds."""
    twin = load_twin(DEFAULT_TWIN)
    log = endless_log(twin, REFOLD_READINGS)
    for name in ("ekf", "ukf"):
        tunings = [twin.tuning.set(twin.tuning.items()[0].key, 0.01 + 0.001 * k) for k in range(5)]
        calls = [partial(_fold_once, name, twin, tuning, log) for tuning in tunings]
        clock, processor = np.median([both(call) for call in calls][1:], axis=0)
        bounds = (Bound("clock [s]", 0.2),) if name == twin.estimator else ()
        yield BenchmarkRow(name, {"clock [s]": clock, "processor [s]": processor}, bounds)


def _fold_once(name: str, twin: Any, tuning: Tuning, log: Log) -> None:
    Fold(name, twin.model, tuning, log, pairs=twin.pairs).advance()


def smoothing() -> Iterator[BenchmarkRow]:
    """Smoothing of 100,000 readings of a car (4 states, 2 rows) beside the fold and beside peers, processor seconds."""
    ys = np.cumsum(np.random.default_rng(0).normal(0, 0.1, (SMOOTHED, 2)), axis=0)
    t = np.arange(SMOOTHED) * (SECOND // 10)
    log = as_log(Events.alike(READING, t, ys))
    for name in SMOOTHERS:
        fold = Fold(name, CAR, Tuning.of(CAR), log)
        folded, smoothed = medians([partial(again, fold), partial(smooth, fold)], 5)
        yield BenchmarkRow(name, {"fold [s]": folded, "smooth [s]": smoothed}, (Bound("smooth [s]", 0.15),))
    peers: dict[str, Callable[[np.ndarray], None]] = {"FilterPy": filterpy_rts, "statsmodels": statsmodels_smoother}
    for name, peer in peers.items():
        (spent,) = medians([partial(peer, ys[:SHORT])], 3)
        yield BenchmarkRow(name, {"smooth [s]": spent * SMOOTHED / SHORT}, remark=f"from {SHORT:,} readings")


def filterpy_rts(ys: np.ndarray) -> None:
    """Filter and smooth."""
    from filterpy.kalman import KalmanFilter

    its = KalmanFilter(4, 2)
    its.x, its.P, its.F, its.Q, its.H, its.R = np.zeros((4, 1)), np.eye(4), F, Q, H, R
    means, covs, _, _ = its.batch_filter(ys[:, :, None])
    its.rts_smoother(means, covs)


def statsmodels_smoother(ys: np.ndarray) -> None:
    """Filter and smooth."""
    from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

    its = KalmanSmoother(2, 4, design=H, transition=F, selection=np.eye(4), obs_cov=R, state_cov=Q)
    its.bind(ys)
    its.initialize_known(np.zeros(4), np.eye(4))
    its.smooth()


@jit_brief
def _nothing_to_refuse(i, now, s, y, context, state, screened):
    return False


@jit_brief
def _nothing_to_note(doubt, most, beyond, index, t):
    return False


@jit_brief
def _nothing_to_watch(start, end, t, kind, channel, value, context, policy, evidence, track):
    pass


UNCACHED = partial(jit, cache=False)
UNCACHED_EMBEDDED = register_jitable(nogil=True, error_model="numpy", forceinline=True, pipeline_class=Linked)
"""`jit` and `embedded` of the fold, whose cache does not know what its functions call."""


NOTHING = {"screen_reading": _nothing_to_refuse, "note": _nothing_to_note, "watch_rows": _nothing_to_watch}
"""In place of plausibility checks, isolation and detectors."""


@lru_cache(maxsize=2)
def kernel(bare: bool) -> Any:
    """Compile the fold's own functions anew, `bare` with predict, update, describe, NIS and its window only.

    Both are compiled here, in one way: the fold's own code, from the cache, takes 10 to 15 % less time per event than
    the same functions compiled here, so that a bare loop beside it seems too slow.
    """
    own = {**fold_kernel.__dict__, **(NOTHING if bare else {})}
    for name in ("fold_event", "run", "judge", "run_and_judge"):
        function = FunctionType(plain(getattr(fold_kernel, name)).__code__, own, name)
        own[name] = (UNCACHED_EMBEDDED if name == "fold_event" else UNCACHED)(function)
    own["run_and_judge"].compile(fold_kernel.run_and_judge_signature.args)
    return own["run_and_judge"]


def defences() -> Iterator[BenchmarkRow]:
    """Folds with plausibility checks, isolation and detectors, and without: µs per event, minima."""
    winding = MODELS["motor_winding"]
    rows = [("motor_winding", "kf", winding, Tuning.of(winding), noisy_log(winding, STEPS))]
    for name, estimator in DEFENDED:
        twin = load_twin(name)
        log, _ = read_log(twin, None)
        if estimator == "pf":
            log.n = min(log.n, PARTICLE_EVENTS)
        tuning = twin.tuning if estimator == twin.estimator else twin.tuning.with_options({})
        rows.append((name, estimator, twin.model, tuning, log))
    for name, estimator, model, tuning, log in rows:
        defended, bare = (Fold(estimator, model, tuning, log) for _ in range(2))
        defended.machine._run, bare.machine._run = kernel(bare=False), kernel(bare=True)
        times = np.array([[seconds(partial(again, fold)) for fold in (defended, bare)] for _ in range(9)])
        least = times[1:].min(axis=0) / log.n * 1e6
        figures = {"all [µs]": least[0], "bare [µs]": least[1], "ratio": least[0] / least[1]}
        yield BenchmarkRow(f"{name} {estimator}", figures, (Bound("ratio", 1.5),))


CHANNELS = (100, 1_000, 4_000)

LOADING = """
import json, sys, time
from app.cli.prepare import fold_log, prepare
from app.twin.log_reader import read_log
from app.twin.twin import load_twin
laps = [time.process_time()]
twin = load_twin(sys.argv[1]); laps.append(time.process_time())
prepare(twin); laps.append(time.process_time())
log, _ = read_log(twin, None); laps.append(time.process_time())
fold_log(twin, log); laps.append(time.process_time())
print(json.dumps([laps, log.n]))
"""
"""A program that loads a twin and folds its log: processor seconds after each step, and the number of events."""


def channels() -> Iterator[BenchmarkRow]:
    """A plant of 40 zones with a column for each thermometer: processor seconds until it runs, µs per event.

    Each case is loaded in two processes: cold without machine code of the model, then with it. The filter is compiled.
    """
    with tempfile.TemporaryDirectory() as folder:
        warm_up = write_plant(Path(folder) / "first", 2, family=False)
        subprocess.run([sys.executable, "-c", LOADING, str(warm_up)], check=True, capture_output=True)
        for count in CHANNELS:
            for family in (False, True):
                path = write_plant(Path(folder) / f"{count}{family}", count, family=family)
                found = []
                for _ in range(2):
                    run = subprocess.run([sys.executable, "-c", LOADING, str(path)], check=True, capture_output=True)
                    found.append(json.loads(run.stdout))
                (cold, _), (warm, events) = found
                imports, load, model, log, fold = np.diff([0.0, *warm])
                figures = {
                    "imports [s]": imports, "YAML [s]": load, "model [s]": model, "log [s]": log,
                    "all [s]": warm[-2], "cold [s]": cold[-2], "fold [µs]": fold / events * 1e6,
                }  # fmt: skip
                bounds = (Bound("all [s]", 10.0), Bound("cold [s]", 27.0)) if count == max(CHANNELS) else ()
                yield BenchmarkRow(f"{count:,} {'of one family' if family else 'sensors'}", figures, bounds)


STARTS = (("twins", 0.4), ("fold motor_winding", 1.0))  # Commands, and the seconds that they may take


def starts(times: int = 5) -> Iterator[BenchmarkRow]:
    """Commands from their start to their end, with compiled code in the cache: medians, s."""
    for words, bound in STARTS:
        found = []
        for _ in range(times + 1):
            begun = perf_counter()
            process = subprocess.Popen(
                [sys.executable, "-m", "app.cli.main", *words.split()],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            _, _, used = os.wait4(process.pid, 0)
            found.append((perf_counter() - begun, used.ru_utime + used.ru_stime))
        clock, processor = np.median(found[1:], axis=0)
        figures = {"clock [s]": clock, "processor [s]": processor}
        yield BenchmarkRow(f"nisus {words}", figures, (Bound("clock [s]", bound),))


def wheels() -> list[Channel]:
    """Return the channels of four wheel speeds, one sensor each."""
    return [
        Channel(
            kind=READING,
            index=k,
            name=f"wheel {name}",
            signals=(f"WHEEL_SPEED_{name}",),
            message="WHEEL_SPEEDS",
            units=(None,),
            model_units=("m/s",),
        )
        for k, name in enumerate(("FR", "FL", "RR", "RL"))
    ]


def imu() -> list[Channel]:
    """Return the channels of an inertial sensor and of a vehicle speed."""
    return [
        Channel(READING, 0, "imu", ("AccelerationY", "AngularRateX"), "gnss_imu"),
        Channel(READING, 1, "speed", ("S01PID0D_VehicleSpeed",), "OBD_RX"),
    ]


def can_logs() -> Iterator[BenchmarkRow]:
    """Reading CAN logs: BLF, one minute of a RAV4 (wheel speeds), and MF4, 40 minutes of a logger (IMU and OBD)."""
    rav4, css = "can_comma2k19_rav4", "can_css_imu100_obd2"
    dbcs = [("canmod-gps.dbc", 2), ("OBD-v4.4.dbc", 1)]
    yield _read_log("BLF", rav4, "*.blf", [("toyota_2017.dbc", 0)], wheels())
    yield _read_log("MF4", css, "session_00000164/*.MF4", dbcs, imu())


def _read_log(
    name: str, recording: str, pattern: str, dbcs: list[tuple[str, int]], channels: list[Channel]
) -> BenchmarkRow:
    """Time the files of a recording by the clock, and by the processor with reader and decoder in this process.

    The first of several rounds loads the reader's libraries, and is not counted.
    """
    folder = data_folder() / recording
    if not folder.exists():
        raise SourceError(f"no recording in {folder}; to get it: nisus data get {recording}")
    files, counts = sorted(folder.glob(pattern)), {}

    def decoder() -> Decoder:
        return Decoder([(folder / "dbc" / file, bus) for file, bus in dbcs], channels, width=2)

    def read() -> None:
        source = CanLog(files, decoder())
        events = 0
        while (batch := source.read(1.0)) is not None:
            events += len(batch)
        counts["frames"], counts["events"] = source.frames, events
        source.close()

    def read_here() -> None:
        own = decoder()
        for path in files:
            for item in (read_mf4 if path.suffix == ".MF4" else read_messages)(path, own.wanted, own.longest):
                if isinstance(item, Raw):
                    own.decode(own.frames_of(item))

    clock = np.median([both(read)[0] for _ in range(6)][1:])
    processor = np.median([seconds(read_here) for _ in range(6)][1:])
    figures = {"clock [s]": clock, "processor [s]": processor, "frames/s": counts["frames"] / clock}
    return BenchmarkRow(name, {**counts, **figures}, (Bound("frames/s", 1e6, at_least=True),))
