"""`nisus compare`: fold every filter that applies to a twin over the same log."""

from __future__ import annotations

from config.loader import shipped
from estimators.errors import ConfigError, SourceError

from ..result import JsonObject, to_json
from ..study.compare import applicable, best_text, compare, without_marks
from ..study.scores import FilterScore, cells, printed, row_json, write_scores
from ..terminal import complain
from ..twin.log_reader import read_logs
from ..twin.twin import load_twin
from .arguments import CompareCommand as Arguments
from .options import overrides_of, span_of
from .prepare import prepare, progress

ALL = "all"  # name that stands for every bundled twin


def compare_twin(arguments: Arguments) -> int:
    """Fold the log of a twin with several filters, and print their scores."""
    if arguments.twin != ALL:
        rows = _compare(arguments, arguments.twin)
        if arguments.json:
            print(to_json(rows))
        return 0
    failed = 0
    found: dict[str, list[JsonObject]] = {}
    for name in shipped():
        try:
            found[name] = _compare(arguments, name)
        except SourceError as error:  # the recording is missing
            complain(error)
            failed = 2
    if arguments.json:
        print(to_json(found))
    return failed


def _compare(arguments: Arguments, name: str) -> list[JsonObject]:
    """Print the table of a twin, unless JSON is wanted, and return its rows for scripts."""
    overrides = overrides_of(arguments)
    twin = load_twin(name, log_files=arguments.log or None, overrides=overrides)
    others = (
        *(arguments.estimators, arguments.set, arguments.tuning, arguments.log),
        *(arguments.duration, arguments.since, arguments.until),
    )
    if arguments.write and (any(others) or arguments.logs > 1):
        raise ConfigError("--write: saves the scores of all filters over the twin's own log; leave other options out")
    names = applicable(twin, arguments.estimators)
    prepare(twin)
    logs = [without_marks(log.events) for log in read_logs(twin, name, overrides, arguments.logs, arguments.duration)]
    scored = span_of(arguments, logs[0])
    rows: list[FilterScore] = []
    ended = False
    with progress(f"{twin.name}, {len(logs[0])} events", len(names), "filters") as advance:
        try:
            for row in compare(
                name, overrides, names, logs, arguments.budget, scored, jobs=arguments.jobs, cluster=arguments.cluster
            ):
                rows.append(row)
                advance(best_text(rows))
        except KeyboardInterrupt:
            if not rows:
                raise
            ended = True
            complain(f"interrupted after {len(rows)} of {len(names)} filters")
    rows.sort(key=lambda row: names.index(row.estimator))
    lines = cells(rows, len(logs[0]), logs[0].seconds)
    if not arguments.json:
        print("\n".join(printed(twin.path.stem, lines, len(logs))))
    if ended:
        raise KeyboardInterrupt
    if arguments.write:
        write_scores(twin.path, lines)
    return [row_json(row) for row in rows]
