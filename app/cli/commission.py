"""`nisus commission`: store the baseline of an accepted tuning in the YAML of the twin."""

from __future__ import annotations

from estimators.diagnostics.calibration import WHOLE
from estimators.diagnostics.detector_tests import COVERED
from estimators.diagnostics.episodes import episodes
from estimators.track import HEALTH_NAMES, STALE

from ..engine.watchdog import interruptible
from ..format_time import duration_text
from ..result import to_json
from ..study.commission import baseline_of, lines, store_baseline
from ..study.fold_result import coverage_of
from ..terminal import complain
from ..twin.log_reader import read_log
from .arguments import CommissionCommand as Arguments
from .prepare import prepared


def commission_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    # What is normal is told from white innovations, not from what was normal before.
    twin = prepared(arguments, baseline="{}")
    log, _ = read_log(twin, arguments.duration)
    fold = twin.fold(log, policy=twin.policy)
    interruptible(fold, fold.advance)
    gaps = [item.size for item in episodes(fold) if item.cause == HEALTH_NAMES[STALE]]
    if gaps:
        complain(
            f"{twin.name}: {len(gaps)} gap(s) without measurements, the longest {duration_text(max(gaps))}; the "
            "estimate is stale there, and they take no part in the baseline"
        )
    for item in coverage_of(fold, slice(0, fold.n)):
        if item.by == WHOLE and item.coverage.high < COVERED:
            complain(
                f"{twin.name}: {item.subject} lies in its 95 % band {100 * item.coverage.value:.0f} % of the time, "
                "which the baseline makes normal; fit the tuning (nisus tune) first"
            )
    normals = baseline_of(fold, twin.name, force=arguments.force)
    text = lines(normals)
    path = store_baseline(twin, text) if arguments.write else None
    if arguments.json:
        written = str(path) if path is not None else None
        head = {"twin": twin.name, "estimator": twin.estimator, "events": log.n, "written": written}
        print(to_json({**head, "commissioned": normals}))
    elif path is not None:
        print(f"{path}: commissioned on {log.n} events of {twin.name}, {twin.estimator}")
    else:
        print(text, end="")
    return 0
