"""Runs, sweeps and noise estimates as JSON for the page."""

from __future__ import annotations

from collections.abc import Container, Sequence

from estimators.registry import ESTIMATORS

from ..columns import units_by_name
from ..derive.run_scores import RunScore, RunScores
from ..derive.sweep import NoiseEstimates, Swept
from ..engine.revisions import Revision
from ..engine.running_fold import Running
from ..result import JsonObject, plain
from ..study.fit_json import nis_json
from ..twin.changes import SettingChange, in_words, units_of


def runs_json(scores: RunScores, engine: Running) -> list[JsonObject]:
    """Return every run, oldest first, with its changes and scores."""
    units, found = units_by_name(engine.model), scores.all()
    there = {run.number for run, _ in found}
    runs = []
    for run, known in found:
        running = run is found[-1][0]
        kept = running or run.track is not None
        names = ("number", "estimator", "began", "first", "loaded", "name", "note", "place")
        runs.append(
            {name: getattr(run, name) for name in names}
            | {
                "title": ESTIMATORS[run.estimator].title,
                "what": what_changed(run, there),
                "running": running,
                "kept": kept,
                "score": None if known is None else _score(known, units),
                "unscored": "" if known else "no measurements yet" if kept else "not scored: its track is gone",
            }
        )
    return runs


def _score(known: RunScore, units: dict[str, str]) -> JsonObject:
    score = known.score
    fits = [(name, "truth", fit) for name, fit in score.states.items()]
    fits += [(name, "held out", fit) for name, fit in score.held_out.items()]
    if score.field is not None:
        fits.append(("all cells", "truth", score.field))
    found = {name: getattr(known, name) for name in ("rows", "seconds", "step_us")}
    names = ("log_likelihood_reading", "log_likelihood", "readings", "refused")
    found |= {name: getattr(score, name) for name in names}
    found |= nis_json(score.nis_verdict)
    found["fits"] = [
        {"name": name, "against": against, "unit": units.get(name, "")} | fit._asdict() for name, against, fit in fits
    ]
    return dict(plain(found))


def what_changed(run: Revision, there: Container[int]) -> str:
    """Describe the changes of a run in words; a run that was loaded is named if it is among those `there`."""
    changes = in_words(run.changes, units=units_of(run.estimator, run.tuning))
    said = ": ".join(part for part in (run.why, changes) if part)
    words = said or ("as it began" if run.first and run.loaded is None else "as before")
    if run.loaded is None:
        return words
    return f"back to {f'run {run.loaded}' if run.loaded in there else 'an earlier run'}: {words}"


def changes_json(changes: Sequence[SettingChange]) -> list[JsonObject]:
    """Return changed entries with their values before and after."""
    return [{"key": key, "values": plain([before, after])} for key, before, after in changes]


def swept_json(swept: Swept) -> JsonObject:
    """Return a sweep as far as it is done, its most likely value, and the value at which the NIS is consistent."""
    best = swept.best
    return plain(swept) | plain({"best": None if best is None else best.value, "level": swept.level})


def noise_json(noise: NoiseEstimates) -> JsonObject:
    """Return the estimated R by key and the sweep of all of Q; `doubt` is the reason not to use an estimate."""
    estimates = {
        key: {"value": found.variance if found.variance > 0.0 else None, "std": found.std, "n": found.n}
        | {"doubt": noise.doubts.get(key, "")}
        for key, found in noise.sensors.items()
    }
    q = swept_json(noise.q) | {"doubt": noise.doubts.get("Q", "")}
    return {"revision": noise.revision, "R": plain(estimates), "reason": noise.reason, "Q": q}
