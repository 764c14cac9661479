"""`nisus tune --windows`: dual estimation over recordings, window after window, as a running twin does it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import PydanticCustomError

from config.fields import as_seconds
from config.files import shown_path
from estimators.errors import ConfigError, printable
from estimators.fit.aims import LIKELIHOOD
from estimators.fit.dual import Refit, against, shift, walk
from estimators.fit.fit import Line
from estimators.fit.recording import Recording

from ..live.runs.runs_json import fit_json
from ..live.tunings.fitted import settings_of
from ..live.tunings.tuning_yaml import tuning_yaml
from ..live.tunings.versions import keep, version_text
from ..present.result import Topic, to_text
from ..terminal import complain
from ..twin.bounds import bounds_of
from ..twin.twin import Twin
from .prepare import attend
from .tune_text import heading

if TYPE_CHECKING:
    from .arguments import Tune as Arguments

Recordings = Callable[["Arguments"], tuple[Twin, list[Recording]]]

UNSEEN = 0.05
"""Share of a window up to which nobody need be told that the end of a log is in none."""


def tune_windows(arguments: Arguments, wanted: Sequence[str], recordings: Recordings) -> int:
    """Carry the command out; `recordings` reads what is named.

    Returns:
        0 if something was adopted, else 1.
    """
    assert arguments.windows is not None
    window = _seconds("--windows", arguments.windows)
    every = window if arguments.every is None else _seconds("--every", arguments.every)
    if arguments.aim not in (None, LIKELIHOOD):
        raise ConfigError(f"--aim {arguments.aim}: windows are fitted by their likelihood; leave it out")
    twin, given = recordings(arguments)
    if any(item.weight != 1.0 for item in given):
        raise ConfigError("--log: with --windows each recording follows the one before; leave the weights out")

    def work() -> list[tuple[int, Refit]]:
        found, tuning = [], twin.tuning
        for k, item in enumerate(given):
            for refit in walk(
                twin.estimator,
                tuning,
                item.log,
                wanted=wanted,
                window=window,
                every=every,
                bounds=bounds_of(twin.config, twin.model),
                blocks=arguments.blocks,
            ):
                # Its rows are many, and nobody asks for them here.
                found.append((k, refit._replace(lived=refit.lived.select(slice(0, 0)).copy())))
                if refit.fitted is not None and refit.proposed:
                    tuning = refit.fitted.setting.tuning
        return found

    found = attend(twin.model, work, "fitting window after window")
    origins = [int(item.log.t[0]) for item in given]
    ends = [int(item.log.t[item.log.n - 1]) for item in given]
    if arguments.json:
        told = [window_json(k, refit, origins[k]) for k, refit in found]
        print(json.dumps({"twin": twin.name, "window": window, "every": every, "windows": told}, allow_nan=False))
    else:
        print("\n".join(to_text([*_sections(found, origins), _verdict(twin, found, origins, ends)])))
    adopted = [refit.fitted for _, refit in found if refit.fitted is not None and refit.proposed]
    if not adopted:
        return 1
    last = adopted[-1]
    if arguments.save is not None:
        arguments.save.write_text(
            heading(twin, last) + tuning_yaml(twin.config, twin.estimator, *last.setting), encoding="utf-8"
        )
    if arguments.keep is not None:
        names = [str(name) for name in arguments.log or (f"{twin.name}, its own log",)]
        settings = settings_of(last, [f"{', '.join(names)}: windows of {window:g} s"], printable(arguments.note))
        path = keep(twin, arguments.keep, version_text(twin, settings))
        complain(f"{shown_path(path)}: kept")
    return 0


def _seconds(option: str, text: str) -> float:
    try:
        value = as_seconds(text)
    except PydanticCustomError:
        try:
            value = float(text)
        except ValueError:
            raise ConfigError(f"{option} {text}: give seconds, or a number with its unit, as in 10min") from None
    if not 0.0 < value < float("inf"):
        raise ConfigError(f"{option} {text}: must be positive")
    return float(value)


def window_json(recording: int, refit: Refit, origin: int) -> dict[str, Any]:
    """A window as JSON: `from` and `to` in seconds after the recording's first event, and the fit as `nisus tune`."""
    told: dict[str, Any] = {
        "recording": recording,
        "from": (refit.start - origin) * 1e-9,
        "to": (refit.end - origin) * 1e-9,
        "events": refit.events,
        "adopted": refit.proposed,
        "reason": refit.reason,
    }
    return told | ({} if refit.fitted is None else {"result": fit_json(refit.fitted)})


def _sections(found: Sequence[tuple[int, Refit]], origins: Sequence[int]) -> list[Topic]:
    """For every entry a table: its value and interval of each window, and what the twin went on with."""
    keys = dict.fromkeys(line.key for _, refit in found if refit.fitted is not None for line in refit.fitted.lines)
    head = (
        *_place(None, None, origins), "fitted", "95 % interval", "σ moved", "gain, nats a reading", "went on with",
    )  # fmt: skip
    sections = []
    for key in keys:
        rows = []
        unit = ""
        for k, refit in found:
            line = _line_of(refit, key)
            unit = unit or ("" if line is None else line.unit)
            rows.append((*_place(k, refit, origins), *_row(refit, line)))
        title = f"{key}{f', {unit}' if unit else ''}"
        sections.append(Topic(title, (), head, tuple(rows)))
    return sections


def _place(k: int | None, refit: Refit | None, origins: Sequence[int]) -> tuple[str, ...]:
    """Recording, where there are several, start and end of a window, s; the head of these columns for None."""
    if k is None or refit is None:
        return (*(("recording",) if len(origins) > 1 else ()), "from s", "to s")
    at = (f"{(t - origins[k]) * 1e-9:,.0f}" for t in (refit.start, refit.end))
    return (*((str(k + 1),) if len(origins) > 1 else ()), *at)


def _line_of(refit: Refit, key: str) -> Line | None:
    lines = () if refit.fitted is None else refit.fitted.lines
    return next((line for line in lines if line.key == key), None)


def _row(refit: Refit, line: Line | None) -> tuple[str, ...]:
    if refit.fitted is None or line is None:
        return ("-", "", "", "", "-")
    verdict = refit.fitted.verdict
    gain = f"{verdict.gain:+.3g} ± {verdict.error:.2g}" if np.isfinite(verdict.gain) else "-"
    kept = f"{line.after if refit.proposed else line.before:.4g}"
    kept += " (adopted)" if refit.proposed and not line.alone else ""
    if line.alone:
        return ("not told", "", "", gain, kept)
    bound = "" if line.told else " (bound)"
    return (f"{line.after:.4g}", f"{line.low:.4g} to {line.high:.4g}{bound}", f"{shift(line):+.1f}", gain, kept)


def _verdict(twin: Twin, found: Sequence[tuple[int, Refit]], origins: Sequence[int], ends: Sequence[int]) -> Topic:
    """How many were adopted, of each other one why not, and what no window looked at."""
    adopted = sum(refit.proposed for _, refit in found)
    folds = sum(refit.fitted.folds for _, refit in found if refit.fitted is not None)
    said = [f"{adopted} of {len(found)} windows were adopted ({twin.estimator}, {folds} folds)."]
    for k, refit in found:
        if not refit.proposed:
            reasons = (refit.reason,) if refit.fitted is None else against(refit.fitted)
            *recording, begin, end = _place(k, refit, origins)
            which = f"recording {recording[0]}, " if recording else ""
            said.append(f"{which}{begin} to {end} s: {'; '.join(reasons)}.")
    for k, last in enumerate(ends):
        own = [refit for other, refit in found if other == k]
        left = (last - max((refit.end for refit in own), default=origins[k])) * 1e-9
        if left > UNSEEN * max((refit.end - refit.start for refit in own), default=0) * 1e-9:
            which = f"Of recording {k + 1} the" if len(ends) > 1 else "The"
            said.append(f"{which} last {left:,.0f} s are less than half a window, or half a step, and were not fitted.")
    return Topic("Verdict", tuple(said))
