"""A learned correction as the text of its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from config.learned_schema import LearnedHeadSection
from config.yaml_text import as_flow, as_section
from estimators.learned.train import Trained
from estimators.model.correction import Correction, GaussianProcess, Net, Ridge
from estimators.model.state_space import StateSpaceModel

from ..live.tunings.versions import now
from ..twin.twin import Twin

DIGITS = 8
"""Significant digits of what was measured."""

LEAST = 1e-3
"""Share of the physics' own drift that a correction which knows nothing is uncertain by, at least."""


def noises_of(
    physics: StateSpaceModel, trained: Trained, corrects: Sequence[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """Variances a second: what is left of the model's own noises where the correction knows, and what it adds else.

    Where it knows nothing the twin is as uncertain as its physics was in these windows. A model with a Q of its own
    keeps that.
    """
    own, learned = {}, {}
    for name, before, rest in zip(corrects, trained.before.tolist(), trained.drift.tolist(), strict=True):
        learned[name] = _rounded(max(before - rest, LEAST * before))
        if physics.Q is None and name in (noise.name for noise in physics.noises):
            own[name] = _rounded(rest)
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
        scores={name: _rounded(value) for name, value in (scores or {}).items()},
    )
    own, learned = noises_of(physics, trained, corrects)
    lines = [
        f"# What {physics.name} leaves out, learned by `nisus learn {twin.name}`. In the YAML of a twin:",
        "#   learned: the name of this file",
        *(f"#   noise: {{{name}: {{variance: {value:g}}}}}   where it knows" for name, value in own.items()),
        *as_section("learned", head.model_dump(mode="json", exclude_defaults=True)),
        f"corrects: {as_flow(list(corrects))}",
        f"features: {as_flow(list(features))}",
        f"noise: {as_flow(learned)}",
        *_numbers(trained.correction, net),
    ]
    return "".join(f"{line}\n" for line in lines)


def _numbers(correction: Correction, net: Path | None) -> list[str]:
    """What the kind is made of, as lines."""
    if isinstance(correction, GaussianProcess):
        lengths = [_rounded(value) for value in correction.lengths.tolist()]
        lines = ["kind: gp", f"lengths: {as_flow(lengths)}", f"ratio: {_rounded(correction.ratio)}"]
    elif isinstance(correction, Ridge):
        lines = ["kind: ridge", f"penalty: {_rounded(correction.penalty)}", f"degree: {correction.degree}"]
    else:
        lines = ["kind: net", f"net: {as_flow(str(net))}"]
    lines += ["points:", *(f"  - {as_flow(_row(row))}" for row in correction.points.tolist())]
    if not isinstance(correction, Net):
        lines += ["rates:", *(f"  - {as_flow(_row(row))}" for row in correction.rates.tolist())]
    return lines


def _row(values: Sequence[float]) -> list[float]:
    return [_rounded(value) for value in values]


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
