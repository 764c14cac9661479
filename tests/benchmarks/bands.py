"""`python -m tests.benchmarks.bands`: bands that hold model error, from the first half of real recordings.

Each twin with recordings is folded twice with the same values: as its file has it with every parameter held (before),
and with every parameter considered, by the covariance that the first half of its own recording gives them and its
`widen` (after). Widths without data are those of the version `considered`, or 10 %. Both are scored on the second half,
and with `--log TWIN=FILE` on whole recordings that no fit saw, against true states and held-out sensors: error (RMS),
mean 2 σ, share in the 95 % band, share withheld, health. `--fit` first fits the parameters to the first half too.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from app.live.tunings.versions import Settings, version_text
from app.present.export.calibration_lines import health_shares
from app.twin.defaults import bounds_of, natural_aim, width_priors
from app.twin.log_reader import read_log
from app.twin.twin import Twin, load_twin, with_held
from config.loader import find
from config.tunings import version_files
from estimators.diagnostics.references import references
from estimators.diagnostics.score import health_of
from estimators.errors import NisusError
from estimators.fit.aims import aim_of
from estimators.fit.entries import Setting
from estimators.fit.fit import fit
from estimators.fit.judge import Z
from estimators.fit.recording import Recording
from estimators.fit.uncertainty import parameter_widths
from estimators.fold import Fold
from estimators.log import Log

from .recordings import CASES, halves

DATA_SHEET = "considered"  # Version that ships with the widths of data sheets


def considered(twin: Twin, first: Log, *, fitted: bool) -> tuple[Settings, str]:
    """Return the settings that a fit to the first half gives a twin, and what the data said, in words."""
    held = with_held(twin)
    prior = width_priors(twin.config, held.model, ()) or width_priors(twin.config, held.model, ("p",))
    recording, setting = Recording(first, 1.0, np.zeros(first.n, bool)), Setting(held.tuning, None)
    if fitted:
        found = fit(
            twin.estimator, held.tuning, [recording], wanted=[f"p.{name}" for name in prior],
            bounds=bounds_of(twin.config, held.model), aim=natural_aim(twin.config), considered=prior,
        )  # fmt: skip
        setting, widths = found.setting, found.widths
    else:
        aim = aim_of(natural_aim(twin.config), twin.estimator, setting, [recording], ())
        widths = parameter_widths(twin.estimator, setting, [recording], prior, aim=aim)
    assert widths is not None
    left = widths.std / widths.prior
    told = f"{np.sum(left < 0.5)} of {left.size} widths less than half of what they are without data"
    return Settings(twin.estimator, setting.tuning, widths=widths), f"{told}, inflation {widths.inflation:.3g}"


def score(twin: Twin, log: Log, part: np.ndarray, what: str) -> None:
    """Print a line for each true state and held-out row of a part (n,) of a log."""
    fold = Fold(twin.estimator, twin.model, twin.tuning, log, policy=twin.policy)
    fold.advance()
    events, track = log.events, fold.track
    health = health_shares(health_of(events.select(part), track.select(part), twin.policy))
    limits = {state.name: state.withhold for state in twin.model.shown_states}
    for item in references(twin.model, events, track):
        kept = part[item.rows]
        error, std = item.error[kept], item.std[kept]
        if not error.size:
            continue
        shown = Z * std <= limits.get(item.name, np.inf)
        inside = np.abs(error) <= Z * std
        coverage = f"{inside[shown].mean():6.1%}" if shown.any() else "     -"
        print(
            f"    {what:8s} {item.name:18s} error {np.sqrt(np.mean(error**2)):9.4g}  2 σ {2 * std.mean():9.4g} "
            f"{item.unit:5s} in band {coverage}, of all {inside.mean():6.1%}, withheld {1 - shown.mean():6.1%}   "
            f"{health}",
            flush=True,
        )


def report(name: str, seconds: float | None, more: Sequence[Path], *, fitted: bool) -> None:
    """Print the table of one twin."""
    shipped = {"tuning": DATA_SHEET} if DATA_SHEET in version_files(find(name)) else {}
    twin = load_twin(name, overrides=shipped)
    log = read_log(twin, seconds)[0]
    first, second = halves(log)
    settings, words = considered(twin, first, fitted=fitted)
    print(f"{name}: {words}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "considered.yaml"
        path.write_text(version_text(twin, settings), encoding="utf-8")
        for file in (None, *more):
            files = None if file is None else [file]
            after = load_twin(name, log_files=files, overrides={"tuning": str(path)})
            if file is not None:
                log = read_log(after, None)[0]
                second = np.ones(log.n, bool)
            print(f"  {'second half' if file is None else file.name}")
            held = with_held(after)
            score(held, log, second, "before")
            score(after, log, second, "after")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("twins", nargs="*", help="default: all with recordings")
    parser.add_argument("--log", action="append", default=[], metavar="TWIN=FILE", help="a recording no fit saw")
    parser.add_argument("--fit", action="store_true", help="fit the parameters to the first half, too")
    given = parser.parse_args()
    more: dict[str, list[Path]] = {}
    for text in given.log:
        twin, _, file = text.partition("=")
        more.setdefault(twin, []).append(Path(file))
    for case in CASES:
        if given.twins and case.twin not in given.twins:
            continue
        try:
            report(case.twin, case.seconds, more.get(case.twin, []), fitted=given.fit)
        except NisusError as error:
            print(f"{case.twin}: {error}", flush=True)


if __name__ == "__main__":
    main()
