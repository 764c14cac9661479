"""What the tests of several rooms share: a second, logs from a few rows, all that a source gives, the same bits."""

import socket
import subprocess
import sys
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from estimators.fold import Fold
from estimators.log import Events, Log
from estimators.model.state_space import StateSpaceModel
from estimators.tuning import Tuning
from tests import ROOT

SECOND = 1_000_000_000
"""Nanoseconds."""


_RESERVED: list[socket.socket] = []


class Clock:
    """Time that passes when a test says so: it sets `now`, or calls `wait` of a clock in ns."""

    def __init__(self, now: float = 0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> bool:
        self.now += round(seconds * SECOND)
        return False


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port of loopback, of TCP or UDP; on Linux the system gives one of TCP to no other process while this one runs.

    There a bound socket that does not listen keeps the port from all but those who share addresses, as servers do.
    """
    sock = socket.socket(type=kind)
    if reserves := kind == socket.SOCK_STREAM and sys.platform == "linux":
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        _RESERVED.append(sock)
    sock.bind(("127.0.0.1", 0))
    port = int(sock.getsockname()[1])
    if not reserves:
        sock.close()
    return port


def run_python(code: str, *arguments: object, status: int = 0, **options: Any) -> subprocess.CompletedProcess[str]:
    """A Python of its own that has run code and ended with this status; for the options see `subprocess.run`."""
    words = [sys.executable, "-c", code, *map(str, arguments)]
    ended = subprocess.run(words, **{"cwd": ROOT, "capture_output": True, "text": True} | options)
    assert ended.returncode == status, ended.stderr
    return ended


def as_log(events: Events) -> Log:
    """A log of these events."""
    log = Log(events.value.shape[1])
    log.extend(events)
    return log


def measured(model: StateSpaceModel, sensor: str, seconds: Any, values: Any, **options: Any) -> Log:
    """A log of measurements of one sensor by name, see `Log.add`; `options` are those of `Log.of`."""
    log = Log.of(model, **options)
    log.add(sensor, seconds, values)
    return log


def log_of(width: int, *rows: tuple[float, int, Any] | tuple[float, int, Any, int]) -> Log:
    """A log of rows (seconds, kind, value) or (seconds, kind, value, channel); without a channel it is the first."""
    batch = []
    for seconds, kind, value, channel in ((*row, 0)[:4] for row in rows):
        t = round(seconds * SECOND)
        batch.append(Events.one(t, t, kind, channel, value, width))
    return as_log(Events.concat(batch, width))


def folded(
    estimator: str,
    model: StateSpaceModel,
    log: Log,
    tuning: Tuning | None = None,
    *,
    options: dict[str, Any] | None = None,
    stop: int | None = None,
    **given: Any,
) -> Fold:
    """A fold of a log, advanced over `stop` events, all by default; `given` are further arguments of `Fold`."""
    tuning = Tuning.of(model) if tuning is None else tuning
    fold = Fold(estimator, model, tuning if options is None else tuning.with_options(options), log, **given)
    fold.advance(stop)
    return fold


def read_all(source: Any) -> Events:
    """Everything that a source gives until its end."""
    batches = []
    while (batch := source.read(0.0)) is not None:
        batches.append(batch)
    return Events.concat(batches, batches[0].value.shape[1])


def error_of(
    kind: type[Exception] | tuple[type[Exception], ...], call: Callable[..., Any], *given: Any, **more: Any
) -> str:
    """The text of the error with which a call is refused, one line."""
    with pytest.raises(kind) as caught:
        call(*given, **more)
    assert "\n" not in (text := str(caught.value))
    return text


def assert_same(a: Iterable[Any], b: Iterable[Any]) -> None:
    """The same bits in every column of two tracks or logs; NaN equals NaN."""
    for name, left, right in zip(a._fields, a, b, strict=True):  # type: ignore[attr-defined]
        np.testing.assert_array_equal(left, right, err_msg=name)


def arrive(growing: Fold, parts: Iterable[Events], rng: np.random.Generator | None = None) -> int:
    """Fold parts of a log in their order of arrival, some of them in pieces if `rng` is given.

    Returns:
        How many parts took back rows that were folded.
    """
    late = 0
    for part in parts:
        changed, _ = growing.log.extend(part)
        late += changed < growing.n
        growing.rewind(changed)
        growing.advance(int(rng.integers(1, 6)) if rng is not None and rng.random() < 0.3 else None)
    growing.advance()
    return late
