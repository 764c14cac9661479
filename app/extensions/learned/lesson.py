"""Result of learning a correction: windows, held-out folds, verdict, JSON, and the text of its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from app.result import JsonObject, Topic
from app.study.fit_json import part_json
from app.twin.twin import Twin
from app.twin.versions import now
from config.yaml_files import as_flow, as_section, rounded
from estimators.diagnostics.sensitivity.responses import digits
from estimators.fit.judge import PartScore
from estimators.model.correction import Correction, GaussianProcess, Net, Ridge
from estimators.model.state_space import StateSpaceModel

from .schema import LearnedHeadSection
from .train import OnWindows, Trained

TUNINGS = ("physics", "physics, its noise from the windows", "with the correction")


class Lesson(NamedTuple):
    """A learned correction: its states and method, residuals in windows, and scores of the folds.

    `learned_from` is of corrections that were trained on the other blocks. `parts` are of the blocks held out, under
    `TUNINGS`; `noise` is the remaining noise of the model, `reasons` are against the correction.
    """

    corrects: tuple[str, ...]
    units: tuple[str, ...]
    words: str
    learned_from: OnWindows
    held_out: OnWindows | None
    parts: tuple[PartScore, ...]
    noise: Mapping[str, float]
    reasons: tuple[str, ...]

    @property
    def better(self) -> bool:
        """Whether the twin is better with it on what it had not seen."""
        return not self.reasons


def sections(name: str, window: float, lesson: Lesson, keep: Path | None) -> list[Topic]:
    """From top to bottom."""
    return [_windows(name, window, lesson), _folds(lesson), _verdict(lesson, keep)]


def as_dict(lesson: Lesson) -> JsonObject:
    """Return the result for scripts."""
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
    """Return scores on the held-out blocks for the correction's file, with those of the physics alone."""
    found: dict[str, float] = {}
    for prefix, part in (("", lesson.parts[2]), ("physics.", lesson.parts[0])):
        found |= {f"{prefix}nis": part.nis, f"{prefix}log_density": part.log_density}
        for name in lesson.corrects:
            if name in part.states:
                state = part.states[name]
                found |= {f"{prefix}rmse.{name}": state.rms, f"{prefix}crps.{name}": state.crps}
                found |= {f"{prefix}coverage.{name}": state.coverage}
    return {name: value for name, value in found.items() if np.isfinite(value)}


def _of_windows(lesson: Lesson, part: OnWindows) -> JsonObject:
    def both(pair: tuple[np.ndarray, np.ndarray], j: int) -> dict[str, float]:
        return {"physics": float(pair[0][j]), "corrected": float(pair[1][j])}

    states = {name: {"rms": both(part.rms, j), "drift": both(part.drift, j)} for j, name in enumerate(lesson.corrects)}
    return {"windows": part.n, "known": part.known, "states": states}


def _windows(name: str, window: float, lesson: Lesson) -> Topic:
    rows: list[tuple[str, ...]] = []
    parts = (("training, cross-validated", lesson.learned_from), ("held out", lesson.held_out))
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
    head = ("windows", "", "", "rate error of the model, RMS", "drift per minute, RMS", "known")
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
    lines = f"In the twin's YAML: correction: {file}" + (f", and noise: {{{noise}}}" if noise else "")
    return Topic("Verdict", ("Better on blocks from which it did not learn.", lines))


DIGITS = 8  # significant digits of measured values
MIN_NOISE_SHARE = 1e-3  # least uncertainty of a correction far from its data, as a share of the drift of the physics


def noises_of(
    physics: StateSpaceModel, trained: Trained, corrects: Sequence[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return variances per second: the remaining model noise near the data, and the added noise far from it.

    Far from the data the twin is as uncertain as the physics was in these windows. A model with its own Q keeps it.
    """
    own, learned = {}, {}
    for name, before, rest in zip(corrects, trained.before.tolist(), trained.drift.tolist(), strict=True):
        learned[name] = rounded(max(before - rest, MIN_NOISE_SHARE * before), DIGITS)
        if physics.Q is None and name in (noise.name for noise in physics.noises):
            own[name] = rounded(rest, DIGITS)
    return own, learned


def correction_text(
    twin: Twin, physics: StateSpaceModel, trained: Trained, corrects: Sequence[str], features: Sequence[str], *,
    learned_on: Sequence[str], net: Path | None, scores: Mapping[str, float] | None = None,
) -> str:  # fmt: skip
    """The YAML of a correction."""
    head = LearnedHeadSection(
        twin=twin.name,
        model=physics.name,
        saved=now(),
        learned_on=tuple(learned_on),
        how=trained.words,
        scores=rounded(dict(scores or {}), DIGITS),
    )
    own, learned = noises_of(physics, trained, corrects)
    lines = [
        f"# What {physics.name} leaves out, learned by `nisus learn {twin.name}`. In the YAML of a twin:",
        "#   correction: the name of this file",
        *(f"#   noise: {{{name}: {{variance: {value:g}}}}}   where it knows" for name, value in own.items()),
        *as_section("learned", head.model_dump(mode="json", exclude_defaults=True)),
        f"corrects: {as_flow(list(corrects))}",
        f"features: {as_flow(list(features))}",
        f"noise: {as_flow(learned)}",
        *_numbers(trained.correction, net),
    ]
    return "".join(f"{line}\n" for line in lines)


def _numbers(correction: Correction, net: Path | None) -> list[str]:
    """Return the parameters of a correction as lines."""
    if isinstance(correction, GaussianProcess):
        lengths = as_flow(rounded(correction.lengths.tolist(), DIGITS))
        lines = ["kind: gp", f"lengths: {lengths}", f"ratio: {rounded(correction.ratio, DIGITS)}"]
    elif isinstance(correction, Ridge):
        lines = ["kind: ridge", f"penalty: {rounded(correction.penalty, DIGITS)}", f"degree: {correction.degree}"]
    else:
        lines = ["kind: net", f"net: {as_flow(str(net))}"]
    lines += ["points:", *(f"  - {as_flow(row)}" for row in rounded(correction.points.tolist(), DIGITS))]
    if not isinstance(correction, Net):
        lines += ["rates:", *(f"  - {as_flow(row)}" for row in rounded(correction.rates.tolist(), DIGITS))]
    return lines
