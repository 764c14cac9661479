"""`nisus filters`: list the estimators, or those that apply to a twin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from estimators.estimator import Option
from estimators.log import READING
from estimators.registry import ESTIMATORS, unfit

from ..present.result import Figure, TableColumn, Topic, to_text
from ..studies.advice.measured import bytes_text
from ..twin.log_reader import read_log
from ..twin.twin import Twin, load_twin
from .prepare import attend

if TYPE_CHECKING:
    from .arguments import FiltersCommand as Arguments

SAMPLE_S = 60.0  # seconds of a twin's source from which its rate is taken


def show_filters(arguments: Arguments) -> int:
    """Run the command."""
    print("\n".join(to_text(catalogue() if arguments.twin is None else [applicable_topic(load_twin(arguments.twin))])))
    return 0


def catalogue() -> list[Topic]:
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
        for entry in ESTIMATORS.values()
    ]


def _option_text(option: Option) -> str:
    unit = f" {option.unit}" if option.unit else ""
    whole = ", integer" if option.whole else ""
    return f"{option.default:g}{unit} ({option.low:g} to {option.high:g}{whole}): {option.meaning}"


def applicable_topic(twin: Twin) -> Topic:
    """Return which estimators apply to a twin, with their cost, and why the others do not."""
    rate = _reading_rate(twin)
    rows = []
    for name, entry in ESTIMATORS.items():
        reason = unfit(entry, twin.model)
        if reason is not None:
            rows.append((name, "", "", f"no: {reason}"))
            continue
        options = entry.complete(dict(twin.options_of(name)))
        numbers = entry.state_size(options, twin.model.nx) + entry.memory(options, twin.model)
        runs = entry.runs(options, twin.model.nx)
        cost = f"{_count_text(runs)} × {rate:.3g} = {_count_text(runs * rate)}"
        applies = "yes, and runs first" if name == twin.estimator else "yes"
        rows.append((name, f"{numbers:,} × 8 B = {bytes_text(8 * numbers)}", cost, applies))
    title = f"{twin.name}: {twin.model.nx:,} states, {rate:.3g} readings per second"
    columns = ("name", TableColumn("memory"), TableColumn("model runs per second"), "applies")
    return Topic(title, (), columns, tuple(rows))


def _reading_rate(twin: Twin) -> float:
    """Return the readings per second in the first minute of the twin's source."""
    log, _ = attend(twin.model, lambda: read_log(twin, SAMPLE_S), "reading the source's first minute")
    times = log.t[: log.n][log.kind[: log.n] == READING]
    return float((times.size - 1) / (times[-1] - times[0]) * 1e9) if times.size > 1 and times[-1] > times[0] else 0.0


def _count_text(count: float) -> str:
    """Return a number of runs: an integer from a hundred on, three digits below."""
    return f"{count:,.0f}" if count >= 100.0 else f"{count:.3g}"
