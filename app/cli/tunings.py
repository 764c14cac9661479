"""`nisus tunings`: list the tuning versions of a twin, compare two, save one or accept one."""

from __future__ import annotations

import numpy as np

from config.tunings import OWN_VALUES
from config.yaml_files import shown_path
from estimators.diagnostics.score import score
from estimators.errors import ConfigError, printable

from ..render.text import to_text
from ..result import JsonObject, TableColumn, Topic, to_json
from ..study.scores import pictures_of
from ..twin.changes import difference, value_text
from ..twin.log_reader import read_log
from ..twin.twin import load_twin
from ..twin.versions import (
    COVERAGE,
    LIKELIHOOD,
    NIS,
    REFUSED,
    Settings,
    accept,
    apply_tuning,
    badness,
    figures,
    keep,
    listing,
    version_text,
)
from .arguments import TuningsCommand as Arguments
from .prepare import fold_log, prepared

SCORE_TITLES = {NIS: "NIS / dof", LIKELIHOOD: "log L per measurement", REFUSED: "share rejected"}


def tunings_of(arguments: Arguments) -> int:
    """List the tuning versions of a twin, or change one."""
    if sum(name is not None for name in (arguments.save, arguments.accept, arguments.apply)) > 1:
        raise ConfigError("--save, --accept and --apply: give one; a version is judged before it is accepted")
    if len(arguments.names) not in (0, 2):
        raise ConfigError(f"tunings: {len(arguments.names)} names; give two versions to compare, or none to list them")
    if arguments.save is not None:
        _save(arguments, arguments.save)
    elif arguments.accept is not None:
        _accept(arguments, arguments.accept)
    elif arguments.apply is not None:
        _apply(arguments, arguments.apply)
    elif arguments.names:
        _compare(arguments)
    else:
        _list(arguments)
    return 0


def _save(arguments: Arguments, name: str) -> None:
    """Fold the twin's log with the given settings, and save them with their scores."""
    twin = prepared(arguments)
    log, _ = read_log(twin, arguments.duration)
    fold = fold_log(twin, log)
    scores = figures(score(fold.track, log.events, twin.model, pictures_of(fold), gate=twin.tuning.gate))
    given = Settings(twin.estimator, twin.tuning, printable(arguments.note), scores=scores)
    path = keep(twin, name, version_text(twin, given))
    _print(arguments, f"{shown_path(path)}: kept", name=name, kept=str(path), scores=scores)


def _accept(arguments: Arguments, name: str) -> None:
    version = load_twin(arguments.twin, overrides={"tuning": name}).version
    if version is None:
        raise ConfigError(f"--accept {OWN_VALUES}: the twin's own file applies until a version is accepted")
    accept(version, printable(arguments.note))
    _print(arguments, f"{shown_path(version.path)}: accepted", name=name, accepted=str(version.path))


def _apply(arguments: Arguments, name: str) -> None:
    twin = load_twin(arguments.twin, overrides={"tuning": name})
    if twin.version is None:
        raise ConfigError(f"--apply {OWN_VALUES}: these are the values of the twin's file")
    model = twin.model
    prior = (model.prior_mean, np.diag(model.prior_std**2)) if twin.version.section.prior else None
    text = apply_tuning(load_twin(arguments.twin), twin.estimator, twin.tuning, prior)
    _print(arguments, text, name=name, applied=str(twin.path))


def _print(arguments: Arguments, text: str, **result: object) -> None:
    print(to_json(result) if arguments.json else text)


def _list(arguments: Arguments) -> None:
    twin = load_twin(arguments.twin)
    listed = listing(twin)
    if arguments.json:
        print(to_json(listed))
        return
    rows = tuple(
        (
            item["name"] + (" *" if item.get("holds") else ""),
            item.get("saved", "-")[:16].replace("T", " "),
            item.get("estimator", "-"),
            item.get("scores", {}).get("nis"),
            item.get("scores", {}).get("log_likelihood"),
            _mean_coverage(item.get("scores", {})),
            ", ".join(item.get("fitted_on", ())) or "-",
            _note(item),
        )
        for item in listed
        if "error" not in item
    )
    inside = TableColumn("in 95 % band [%]", 1, 100.0)
    columns = ("version", "saved", "filter", "NIS / dof", TableColumn("log L"), inside, "fitted on", "note")
    topics = [Topic(f"Tuning versions of {twin.name}", ("* accepted: `nisus guard` folds with it.",), columns, rows)]
    if broken := tuple(item["error"] for item in listed if "error" in item):
        topics.append(Topic("Cannot be read", broken))
    print(to_text(topics))


def _mean_coverage(scores: dict[str, float]) -> float | None:
    covered = [value for name, value in scores.items() if name.startswith(f"{COVERAGE}.")]
    return sum(covered) / len(covered) if covered else None


def _note(item: JsonObject) -> str:
    if item["name"] == OWN_VALUES:
        return "the twin's file"
    accepted = item["accepted"]
    notes = [item["note"], f"accepted: {accepted['note']}" if accepted and accepted["note"] else ""]
    return "; ".join(filter(None, notes))


def _compare(arguments: Arguments) -> None:
    """Print the entries in which two versions differ, and their scores with the change for the worse."""
    first, second = (load_twin(arguments.twin, overrides={"tuning": name}) for name in arguments.names)
    differ = difference(first.estimator, first.tuning, second.estimator, second.tuning)
    scores = [dict(twin.version.head.scores) if twin.version is not None else {} for twin in (first, second)]
    if arguments.json:
        entries = [{"key": key, "values": [before, after]} for key, before, after in differ]
        print(to_json({"names": arguments.names, "entries": entries, "scores": scores}))
        return
    names = tuple(arguments.names)
    rows = tuple(
        (
            SCORE_TITLES.get(name, name),
            f"{before:.6g}",
            f"{scores[1][name]:.6g}",
            _verdict(name, before, scores[1][name]),
        )
        for name, before in scores[0].items()
        if name in scores[1]
    )
    entries_of = tuple((key, value_text(before), value_text(after)) for key, before, after in differ)
    differing = Topic("Entries that differ", () if entries_of else ("None.",), ("entry", *names), entries_of)
    scored = Topic("Scores", () if rows else ("Both versions need scores.",), ("score", *names, ""), rows)
    print(to_text([differing, scored]))


def _verdict(name: str, before: float, after: float) -> str:
    """Return whether a score got better or worse, as `nisus guard` counts."""
    change = badness(name, after) - badness(name, before)
    return "worse" if change > 0.0 else "better" if change < 0.0 else ""
