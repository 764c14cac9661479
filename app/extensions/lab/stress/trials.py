"""All trials of a twin: each mistake with each filter and seed, in parallel."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from app.study.processes import results
from app.twin.twin import Twin, load_twin
from estimators.errors import NisusError

from .detection import Oracle, Trial, make
from .matrix import matrix
from .scenario import Bench, Mistake, asset_of


class Trials:
    """Mistakes with a twin, the logs in which they are made, and their expected detection.

    Args:
        twin: As it ships.
        duration: Seconds of the logs.
    """

    def __init__(self, twin: Twin, duration: float) -> None:
        self.oracle, self._twin, self._duration = Oracle(twin, duration), twin, duration
        self._benches = [Bench(twin, 0, duration)]
        asset = asset_of(twin, 0) is not None
        self.mistakes = matrix(twin.model, twin.tuning, self._benches[0].events, asset=asset)

    def make(self, k: int, estimator: str, seed: int) -> Trial:
        """Make mistake number `k`.

        Raises:
            NisusError: As `Bench.run`.
        """
        first, mistake = self._benches[0], self.mistakes[k]
        # Of the others, calls mostly want the last one again.
        if self._benches[-1].seed != seed:
            self._benches[1:] = [Bench(self._twin, seed, self._duration)] if seed else []
        bench = self._benches[-1]
        foretold = self.oracle.foretell(bench, mistake, estimator)
        listed = self.oracle.listed(first, mistake, estimator)
        return make(bench, mistake, estimator, foretold, listed=listed)


def all_trials(
    twin: str,
    overrides: Mapping[str, str],
    log_files: Sequence[Path],
    duration: float,
    chosen: Sequence[tuple[int, Mistake]],
    names: Sequence[str],
    seeds: int,
    *,
    jobs: int | None = None,
    cluster: str | None = None,
) -> Iterator[tuple[int, Trial | str]]:
    """Yield number and trial, or why there is none, for each seed, filter and mistake, as they are done.

    The twin is a name or path, with overrides and log files as of `load_twin`; `chosen` mistakes have their numbers;
    `jobs` and `cluster` are those of `results`.
    """
    calls = [(k, item.name, name, seed) for seed in range(seeds) for name in names for k, item in chosen]
    given = (twin, dict(overrides), tuple(log_files), duration)
    return results(_make, calls, jobs=jobs, cluster=cluster, begin=_share, given=given)


_shared: list[Trials] = []
"""Of a worker process."""


def _share(twin: str, overrides: dict[str, str], log_files: tuple[Path, ...], duration: float) -> None:
    _shared[:] = [Trials(load_twin(twin, log_files=log_files or None, overrides=overrides), duration)]


def _make(k: int, mistake: str, estimator: str, seed: int) -> Trial | str:
    try:
        return _shared[0].make(k, estimator, seed)
    except NisusError as error:
        return f"{mistake}, {estimator}, seed {seed}: {error}"
