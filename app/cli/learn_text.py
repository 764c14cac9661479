"""What `nisus learn` found, as sections of tables and as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimators.diagnostics.sensitivity.responses import digits
from estimators.fit.judge import Part
from estimators.learned.train import OnWindows

from ..live.runs.runs_json import part_json
from ..present.result import Topic

TUNINGS = ("physics", "physics, its noise from the windows", "with the correction")


class Lesson(NamedTuple):
    """What was learned: of which states and how, what is left over in windows, and what the folds are worth.

    `learned_from` is of corrections that were trained on the other blocks. `parts` are of the blocks held out, under
    `TUNINGS`; `noise` is what is left of the model's own noise, `reasons` what speaks against the correction.
    """

    corrects: tuple[str, ...]
    units: tuple[str, ...]
    words: str
    learned_from: OnWindows
    held_out: OnWindows | None
    parts: tuple[Part, ...]
    noise: Mapping[str, float]
    reasons: tuple[str, ...]

    @property
    def better(self) -> bool:
        """Whether the twin is better with it on what it had not seen."""
        return not self.reasons


def sections(name: str, window: float, lesson: Lesson, keep: Path | None) -> list[Topic]:
    """From top to bottom."""
    return [_windows(name, window, lesson), _folds(lesson), _verdict(lesson, keep)]


def as_dict(lesson: Lesson) -> dict[str, Any]:
    """For a script; null stands for what is not a number."""
    held_out = lesson.held_out
    return {
        "better": lesson.better,
        "reasons": list(lesson.reasons),
        "how": lesson.words,
        "noise": dict(lesson.noise),
        "windows": {
            "learned_from": _of_windows(lesson, lesson.learned_from),
            "held_out": None if held_out is None else _of_windows(lesson, held_out),
        },
        "held_out": dict(zip(("physics", "physics_wider", "corrected"), map(part_json, lesson.parts), strict=True)),
    }


def scores_of(lesson: Lesson) -> dict[str, float]:
    """What the correction's file says of its worth on the blocks held out, and of the physics alone there."""
    found: dict[str, float] = {}
    for prefix, part in (("", lesson.parts[2]), ("physics.", lesson.parts[0])):
        found |= {f"{prefix}nis": part.nis, f"{prefix}log_density": part.log_density}
        for name in lesson.corrects:
            if name in part.states:
                state = part.states[name]
                found |= {f"{prefix}rmse.{name}": state.rms, f"{prefix}crps.{name}": state.crps}
                found |= {f"{prefix}coverage.{name}": state.coverage}
    return {name: value for name, value in found.items() if np.isfinite(value)}


def _of_windows(lesson: Lesson, part: OnWindows) -> dict[str, Any]:
    def both(pair: tuple[np.ndarray, np.ndarray], j: int) -> dict[str, float]:
        return {"physics": float(pair[0][j]), "corrected": float(pair[1][j])}

    states = {name: {"rms": both(part.rms, j), "drift": both(part.drift, j)} for j, name in enumerate(lesson.corrects)}
    return {"windows": part.n, "known": part.known, "states": states}


def _windows(name: str, window: float, lesson: Lesson) -> Topic:
    rows: list[tuple[str, ...]] = []
    parts = (("learned from, each block without itself", lesson.learned_from), ("held out", lesson.held_out))
    for what, part in parts:
        if part is None:
            continue
        for j, (state, unit) in enumerate(zip(lesson.corrects, lesson.units, strict=True)):
            rows.append(
                (
                    what,
                    str(part.n),
                    state,
                    f"{digits(part.rms[0][j])} -> {digits(part.rms[1][j])} {unit}/s",
                    f"{digits(np.sqrt(60.0 * part.drift[0][j]))} -> {digits(np.sqrt(60.0 * part.drift[1][j]))} {unit}",
                    f"{100.0 * part.known:.0f} %",
                )
            )
    head = ("windows", "", "", "rate by which the model is wrong, RMS", "drift of a minute, RMS", "known")
    return Topic(f"{name}: windows of {window:g} s, {lesson.words}", (), head, tuple(rows))


def _folds(lesson: Lesson) -> Topic:
    first = lesson.parts[0]
    rows: list[tuple[str, ...]] = []
    for kind, group in (("true", "states"), ("sensor", "sensors")):
        for name, one in getattr(first, group).items():
            found = [getattr(part, group)[name] for part in lesson.parts]
            unit = f" {one.unit}"
            rows += [
                (f"{kind} {name}, RMSE", *(f"{digits(item.rms)}{unit}" for item in found)),
                (f"{kind} {name}, CRPS", *(f"{digits(item.crps)}{unit}" for item in found)),
                (f"{kind} {name}, in the 95 % band", *(f"{100.0 * item.coverage:.1f} %" for item in found)),
            ]
    rows += [
        ("NIS / dof", *(f"{part.nis:.3f}" for part in lesson.parts)),
        ("log density of a reading, nats", *(f"{part.log_density:.4f}" for part in lesson.parts)),
    ]
    said = (f"{first.n:,} readings; sensors are each held out in turn.",)
    return Topic("Blocks held out, folded", said, ("", *TUNINGS), tuple(rows))


def _verdict(lesson: Lesson, keep: Path | None) -> Topic:
    if not lesson.better:
        return Topic("Verdict", ("Not better than the physics alone, so nothing is kept:", *lesson.reasons))
    noise = ", ".join(f"{name}: {{variance: {value:g}}}" for name, value in lesson.noise.items())
    file = keep.name if keep else "FILE"
    lines = f"In the twin's YAML: learned: {file}" + (f", and noise: {{{noise}}}" if noise else "")
    return Topic("Verdict", ("Better on blocks from which it did not learn.", lines))
