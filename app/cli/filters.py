"""`nisus filters`: list the estimators, or those that apply to a twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from config.loader import shipped
from estimators.errors import ConfigError, nearest, quoted
from estimators.estimator import Estimator, Option
from estimators.log import READING
from estimators.registry import ESTIMATORS, unfit

from ..render.text import to_text
from ..result import Figure, JsonObject, TableColumn, Topic, to_json
from ..study.advice.measured import bytes_text
from ..twin.log_reader import read_log
from ..twin.twin import Twin, load_twin
from .arguments import FiltersCommand as Arguments
from .prepare import attend

SAMPLE_S = (60.0, 3.2e7)  # seconds of a twin's source from which its rate is taken, the first that have enough readings
MIN_SAMPLE = 10


def show_filters(arguments: Arguments) -> int:
    """List the filters, describe one, or show which apply to a twin."""
    twin, shown = arguments.twin, ESTIMATORS
    if arguments.name in ESTIMATORS:
        shown = {arguments.name: ESTIMATORS[arguments.name]}
    elif arguments.name is not None and twin is None:
        twin = arguments.name
        if not twin.endswith((".yaml", ".yml")) and twin not in shipped():
            raise ConfigError(
                f"{quoted(twin)}: no estimator or bundled twin; {nearest(twin, [*ESTIMATORS, *shipped()])}"
            )
    if twin is None:
        print(to_json(catalogue_json(shown)) if arguments.json else to_text(catalogue(shown)))
        return 0
    found = applicable(load_twin(twin))
    print(to_json(found) if arguments.json else to_text([applicable_topic(found)]))
    return 0


def catalogue_json(shown: Mapping[str, Estimator] = ESTIMATORS) -> list[JsonObject]:
    """Return estimators for scripts."""
    words = ("name", "family", "title", "assumes", "model_runs", "fails_when", "source", "options")
    return [{word: getattr(entry, word) for word in words} for entry in shown.values()]


def catalogue(shown: Mapping[str, Estimator] = ESTIMATORS) -> list[Topic]:
    """Return a topic per estimator: assumption, options, cost, failure and source."""
    return [
        Topic(
            f"{entry.name} ({entry.family})",
            (f"{entry.title}: {entry.assumes}",),
            figures=(
                *(Figure(option.name, _option_text(option)) for option in entry.options),
                Figure("model runs per step", entry.model_runs),
                Figure("fails when", entry.fails_when),
                Figure("source", entry.source),
            ),
        )
        for entry in shown.values()
    ]


def _option_text(option: Option) -> str:
    unit = f" {option.unit}" if option.unit else ""
    whole = ", integer" if option.whole else ""
    return f"{option.default:g}{unit} ({option.low:g} to {option.high:g}{whole}): {option.meaning}"


@dataclass(frozen=True)
class Applicability:
    """Whether an estimator applies to a twin, with bytes and model runs per second; `reason` why it does not."""

    name: str
    applies: bool
    first: bool
    bytes: int | None
    model_runs_per_step: float | None
    model_runs_per_second: float | None
    reason: str | None


@dataclass(frozen=True)
class TwinFilters:
    """Estimators for a twin; `rate` in measurements per second."""

    twin: str
    states: int
    rate: float
    filters: list[Applicability]


def applicable(twin: Twin) -> TwinFilters:
    """Return which estimators apply to a twin, with their cost, and why the others do not."""
    rate, nx = _reading_rate(twin), twin.model.nx
    found = []
    for name, entry in ESTIMATORS.items():
        reason = unfit(entry, twin.model)
        if reason is not None:
            found.append(Applicability(name, False, False, None, None, None, reason))
            continue
        options = entry.complete(dict(twin.options_of(name)))
        size = 8 * (entry.state_size(options, nx) + entry.memory(options, twin.model))
        runs = float(entry.runs(options, nx))
        found.append(Applicability(name, True, name == twin.estimator, size, runs, runs * rate, None))
    return TwinFilters(twin.name, nx, rate, found)


def applicable_topic(found: TwinFilters) -> Topic:
    """Return which estimators apply as a table."""
    rows = []
    for one in found.filters:
        if one.bytes is None or one.model_runs_per_step is None or one.model_runs_per_second is None:
            rows.append((one.name, "", "", f"no: {one.reason}"))
            continue
        runs = one.model_runs_per_step
        cost = f"{_count_text(runs)} × {found.rate:.3g} = {_count_text(one.model_runs_per_second)}"
        applies = "yes, and runs first" if one.first else "yes"
        rows.append((one.name, f"{one.bytes // 8:,} × 8 B = {bytes_text(one.bytes)}", cost, applies))
    title = f"{found.twin}: {found.states:,} states, {found.rate:.3g} readings per second"
    columns = ("name", TableColumn("memory"), TableColumn("model runs per second"), "applies")
    return Topic(title, (), columns, tuple(rows))


def _reading_rate(twin: Twin) -> float:
    """Return the readings per second in the first minute of the twin's source, or in the first year of a slow one."""
    times = np.zeros(0)
    for seconds in SAMPLE_S:
        log, _ = attend(twin.model, partial(read_log, twin, seconds), "reading the source")
        times = log.events.t[log.events.kind == READING]
        if times.size > MIN_SAMPLE:
            break
    return float((times.size - 1) / (times[-1] - times[0]) * 1e9) if times.size > 1 and times[-1] > times[0] else 0.0


def _count_text(count: float) -> str:
    """Return a number of runs: an integer from a hundred on, three digits below."""
    return f"{count:,.0f}" if count >= 100.0 else f"{count:.3g}"
