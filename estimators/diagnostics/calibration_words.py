"""Calibration in words: what is said of figures that matter, and when they do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from .intervals import Interval


class Limits(NamedTuple):
    """Sizes from which on something is said: the whole interval of a figure must lie beyond.

    Bands that would have to be wider by more than the share `width` to be right, or are wider by more than that than
    they would have to be; a bias of more than `bias` σ; a correlation of more than `correlation`, either sign; more
    than the share `refused` of the readings.
    """

    width: float = 0.25
    bias: float = 0.25
    correlation: float = 0.2
    refused: float = 0.05


class Verdict(NamedTuple):
    """A band, by the share that it should hold, and the share that it does, which is beyond the limits."""

    band: float
    share: Interval


FRACTIONS = (
    (0.225, "a fifth"),
    (0.29, "a quarter"),
    (0.415, "a third"),
    (0.58, "a half"),
    (0.7, "two thirds"),
    (0.85, "three quarters"),
)
"""Fractions in words, each up to the middle between it and the next."""


def reading_words(
    name: str, scale: Interval, bias: Interval, correlation: Interval, refused: Interval, limits: Limits
) -> tuple[str, ...]:
    """What matters of a sensor row whose readings are used."""
    said = []
    if scale.beyond(1.0 / (1.0 + limits.width), 1.0 + limits.width):
        said.append(f"{name}: bands {_off(scale.value)} (scale {_figures(scale, '.2f')})")
    if bias.beyond(-limits.bias, limits.bias):
        side = "above" if bias.value > 0.0 else "below"
        said.append(f"{name}: reads {side} the prediction (bias {_figures(bias, '+.2f')} σ)")
    if correlation.beyond(-limits.correlation, limits.correlation):
        why = "Q too small, or a state is missing" if correlation.value > 0.0 else "Q too large"
        said.append(f"{name}: innovations are correlated ({_figures(correlation, '+.2f')}): {why}")
    if refused.beyond(0.0, limits.refused):
        said.append(f"{name}: the gate refuses {_share(refused)} of the readings")
    return tuple(said)


def held_out_words(name: str, verdicts: Sequence[Verdict]) -> tuple[str, ...]:
    """What matters of a sensor row that is held out: the widest band that holds too many or too few."""
    return tuple(
        f"{name}: {_share(share)} of its readings in the {100 * band:.0f} % band of the prediction{_wide(band, share)}"
        for band, share in verdicts[:1]
    )


def truth_words(name: str, verdicts: Sequence[Verdict], bias: Interval, limits: Limits) -> tuple[str, ...]:
    """What matters of a state whose truth is told."""
    said = [
        f"{name}: truth in its {100 * band:.0f} % band {_share(share)} of the time{_wide(band, share)}"
        for band, share in verdicts[:1]
    ]
    if bias.beyond(-limits.bias, limits.bias):
        side = "above" if bias.value > 0.0 else "below"
        said.append(f"{name}: truth {side} the estimate (bias {_figures(bias, '+.2f')} σ)")
    return tuple(said)


def _off(scale: float) -> str:
    """How far bands are off that would have to be `scale` times as wide."""
    if not scale > 0.0:
        return "far too wide: the readings never differ from the prediction"
    factor, side = (scale, "too narrow") if scale > 1.0 else (1.0 / scale, "too wide")
    fraction = next((word for limit, word in FRACTIONS if factor - 1.0 < limit), None)
    return f"{fraction} {side}" if fraction else f"{side} by a factor of {factor:.2g}"


def _figures(figure: Interval, form: str) -> str:
    """Value, low to high."""
    value, low, high = (format(number, form) for number in figure)
    return f"{value}, {low} to {high}"


def _wide(band: float, share: Interval) -> str:
    return ", too wide" if share.value > band else ""


def _share(share: Interval) -> str:
    return f"{100 * share.value:.3g} % ({100 * share.low:.3g} to {100 * share.high:.3g})"
