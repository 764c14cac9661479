"""Executor on a Dask cluster for the folds of one twin, for commands whose calls follow from earlier results."""

from __future__ import annotations

import io
import pickle
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import partial
from time import perf_counter
from typing import Any

from app.twin.twin import Twin, load_twin, with_held

from .workers import Cluster, dask

TASK_S = 0.1  # seconds of a task at least: a cluster takes a few milliseconds for one

PROTOCOL = 4
"""Pickles of this protocol copy the numbers of an array. Dask's own are views of a message, where a float may begin at
any byte, and NumPy sums those in another order: not the same bits."""

MAX_KEPT = 4  # functions that a worker keeps, the last ones

_functions: list[Callable[..., object]] = []
"""Model functions of the twin that this worker has loaded."""

_kept: dict[str, Callable[..., object]] = {}
"""Functions that were sent to this worker, by key."""


@contextmanager
def folds_of(cluster: str, twin: Twin, held: Twin, name: str, overrides: Mapping[str, str]) -> Iterator[Executor]:
    """Context manager: an Executor for the folds of a twin; see `app.study.processes.executor_of`."""
    with dask(cluster, _load, (name, dict(overrides))) as workers:
        yield ClusterExecutor(workers, [*functions_of(twin.model), *functions_of(held.model)])


class ClusterExecutor(Executor):
    """Executor whose `map` sends its function once to each worker, and items in tasks of `TASK_S` or more.

    A model has local functions and machine code, which cannot be pickled: a worker uses those of its own twin.
    """

    def __init__(self, cluster: Cluster, functions: list[Callable[..., object]]) -> None:
        """Take the workers of a cluster, and the functions that they have, too."""
        self._cluster, self._functions = cluster, functions  # pickled by their places in this list
        self._sent: dict[object, tuple[Callable[..., object], object]] = {}
        self._seconds: dict[object, float] = {}

    def submit(self, fn: Callable[..., object], /, *given: object, **named: object) -> Future:
        """Submit one call."""
        return self._cluster.submit(_call, packed(partial(fn, *given, **named), self._functions))

    def map(self, fn: Callable[..., object], *iterables: Iterable, **_: object) -> Iterator:
        """Submit all calls, and return their results in order; calls that have not begun are cancelled at the end."""
        items = list(zip(*iterables, strict=False))
        # A partial of the same objects is the same function. Keeping it keeps their identities.
        key = (fn.func, *map(id, fn.args)) if isinstance(fn, partial) else fn
        if key not in self._sent:
            self._sent[key] = fn, self._cluster.hold((uuid.uuid4().hex, packed(fn, self._functions)))
        # The first calls, one a worker, measure how long one takes.
        first = len(items) if key in self._seconds else max(1, self._cluster.workers())
        return self._results(key, self._tasks(key, items[:first]), items[first:])

    def _tasks(self, key: object, items: list[tuple[object, ...]]) -> list[Future[tuple[float, bytes]]]:
        share = -(-len(items) // max(1, self._cluster.workers()))
        count = max(1, min(share, round(TASK_S / max(self._seconds.get(key, TASK_S), 1e-6))))
        parts = [items[k : k + count] for k in range(0, len(items), count)]
        return [self._cluster.submit(_calls, self._sent[key][1], part) for part in parts]

    def _results(self, key: object, futures: list[Future], rest: list[tuple[object, ...]]) -> Iterator:
        try:
            for future in futures:
                self._seconds[key], found = future.result()
                if rest:
                    futures += self._tasks(key, rest)
                    rest = []
                yield from pickle.loads(found)
        finally:
            for future in futures:
                future.cancel()


def functions_of(item: object) -> list[Callable[..., object]]:
    """Return the functions in a model, in the order of its fields."""
    if callable(item):
        return [item]
    if isinstance(item, tuple):
        return [function for part in item for function in functions_of(part)]
    if not is_dataclass(item):
        return []
    return [function for part in fields(item) for function in functions_of(getattr(item, part.name))]


def packed(value: object, functions: list[Callable[..., object]]) -> bytes:
    """Return a pickle in which functions are places in a list that the receiver has, too."""
    from cloudpickle import Pickler  # type: ignore[import-untyped]  # comes with Dask

    places = {id(function): k for k, function in enumerate(functions)}

    class Packer(Pickler):  # type: ignore[misc]
        def persistent_id(self, item: object) -> int | None:
            return places.get(id(item)) if callable(item) else None

    file = io.BytesIO()
    Packer(file, PROTOCOL).dump(value)
    return file.getvalue()


def unpacked(data: bytes, functions: list[Callable[..., object]]) -> Any:
    """Return what `packed` has packed."""

    class Unpacker(pickle.Unpickler):
        def persistent_load(self, place: int) -> object:
            return functions[place]

    return Unpacker(io.BytesIO(data)).load()


def _load(name: str, overrides: dict[str, str]) -> None:
    twin = load_twin(name, overrides=overrides)
    _functions[:] = [*functions_of(twin.model), *functions_of(with_held(twin).model)]
    _kept.clear()


def _call(data: bytes) -> object:
    return unpacked(data, _functions)()


def _calls(sent: tuple[str, bytes], items: list[tuple[object, ...]]) -> tuple[float, bytes]:
    """Return the seconds of a call and the results of all, pickled."""
    key, data = sent
    if key not in _kept:
        while len(_kept) >= MAX_KEPT:
            del _kept[next(iter(_kept))]
        _kept[key] = unpacked(data, _functions)
    begun = perf_counter()
    found = [_kept[key](*item) for item in items]
    return (perf_counter() - begun) / len(items), pickle.dumps(found, PROTOCOL)
