"""`nisus tunings`: the tuning versions of a twin listed, two compared, one kept or accepted."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from config.tunings import OWN
from config.yaml_files import shown_path
from estimators.diagnostics.score import score
from estimators.errors import ConfigError, printable
from estimators.fold import Fold

from ..live.changes import difference
from ..live.tunings.versions import COVERAGE, Settings, accept, figures, keep, listing, version_text
from ..live.watchdog import interruptible
from ..present.result import Topic, to_text
from ..twin.log_reader import read_log
from ..twin.twin import load_twin
from .options import settings
from .prepare import prepare

if TYPE_CHECKING:
    from .arguments import Tunings as Arguments


def tunings_of(arguments: Arguments) -> int:
    """Carry the command out."""
    if arguments.save is not None and arguments.accept is not None:
        raise ConfigError("--save and --accept: one after the other; a version is judged before it is accepted")
    if len(arguments.names) not in (0, 2):
        raise ConfigError(f"tunings: {len(arguments.names)} names; give two versions to compare, or none to list them")
    if arguments.save is not None:
        print(_saved(arguments, arguments.save))
    elif arguments.accept is not None:
        _accept(arguments, arguments.accept)
    elif arguments.names:
        _compare(arguments)
    else:
        _list(arguments)
    return 0


def _saved(arguments: Arguments, name: str) -> str:
    """Fold the twin's log with these settings, and keep them with what they were worth."""
    overrides = settings(arguments.set, arguments.estimator, arguments.tuning)
    twin = load_twin(arguments.twin, log_files=arguments.log or None, overrides=overrides)
    prepare(twin)
    log, _ = read_log(twin, arguments.duration)
    fold = Fold(twin.estimator, twin.model, twin.tuning, log, policy=twin.policy, expected=twin.expected)

    def work() -> None:
        fold.advance()
        fold.finish()

    interruptible(fold, work)
    pictures = fold.pictures.taken if fold.pictures is not None else []
    found = score(fold.track, log.events, twin.model, pictures, gate=twin.tuning.gate)
    given = Settings(twin.estimator, twin.tuning, printable(arguments.note), scores=figures(found))
    return f"{shown_path(keep(twin, name, version_text(twin, given)))}: kept"


def _accept(arguments: Arguments, name: str) -> None:
    twin = load_twin(arguments.twin, overrides={"tuning": name})
    if twin.version is None:
        raise ConfigError(
            f"--accept {OWN}: what the twin's file says needs no accepting; it holds while nothing else does"
        )
    accept(twin.version, printable(arguments.note))
    print(f"{shown_path(twin.version.path)}: accepted")


def _list(arguments: Arguments) -> None:
    twin = load_twin(arguments.twin)
    listed = listing(twin)
    if arguments.json:
        print(json.dumps(listed))
        return
    broken = tuple(item["error"] for item in listed if "error" in item)
    rows = tuple(
        (
            item["name"] + (" *" if item.get("holds") else ""),
            item.get("saved", "-")[:16].replace("T", " "),
            item.get("estimator", "-"),
            *_scored(item.get("scores", {})),
            ", ".join(item.get("fitted_on", ())) or "-",
            _noted(item),
        )
        for item in listed
        if "error" not in item
    )
    head = ("version", "saved", "filter", "NIS", "log L", "in 95 %", "fitted on", "note")
    said = ("*: holds; `nisus guard` folds with it.",)
    parts = [Topic(f"Tuning versions of {twin.name}", said, head, rows)]
    if broken:
        parts.append(Topic("Cannot be read", broken))
    print("\n".join(to_text(parts)))


def _scored(scores: dict[str, float]) -> tuple[str, str, str]:
    covered = [value for name, value in scores.items() if name.startswith(f"{COVERAGE}.")]
    inside = f"{100 * sum(covered) / len(covered):.1f}" if covered else "-"
    nis, likelihood = (f"{scores[name]:.4g}" if name in scores else "-" for name in ("nis", "log_likelihood"))
    return nis, likelihood, inside


def _noted(item: dict[str, Any]) -> str:
    if item["name"] == OWN:
        return "what the twin's file says"
    accepted = item["accepted"]
    said = [item["note"], f"accepted: {accepted['note']}" if accepted and accepted["note"] else ""]
    return "; ".join(filter(None, said))


def _compare(arguments: Arguments) -> None:
    first, second = (load_twin(arguments.twin, overrides={"tuning": name}) for name in arguments.names)
    differ = difference(first.estimator, first.tuning, second.estimator, second.tuning)
    scores = [dict(twin.version.head.scores) if twin.version is not None else {} for twin in (first, second)]
    both = [name for name in scores[0] if name in scores[1]]
    if arguments.json:
        entries = [{"key": key, "values": [before, after]} for key, before, after in differ]
        print(json.dumps({"names": arguments.names, "entries": entries, "scores": scores}))
        return
    names = tuple(arguments.names)
    entries_of = tuple((key, _shown(before), _shown(after)) for key, before, after in differ)
    parts = [
        Topic("Entries that differ", () if entries_of else ("None.",), ("entry", *names), entries_of),
        Topic("Scores", () if both else ("Not both were scored.",), ("score", *names),
             tuple((name, *(f"{each[name]:.6g}" for each in scores)) for name in both)),
    ]  # fmt: skip
    print("\n".join(to_text(parts)))


def _shown(value: float | bool | str | None) -> str:
    return "off" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
