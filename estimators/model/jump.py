"""A discrete mode: one state of a model that takes the values 0, 1, … and jumps among them.

    m' ~ chances(x, u, p, dt),   then   x' = f(x with m', u, p, dt) + w

Filters that sample draw the jump; the others see the model of mode_as_number.py.

Source: Doucet, Gordon & Krishnamurthy (2001), Particle filters for state estimation of jump Markov linear systems,
doi:10.1109/78.905890, section II (the mode jumps first, then the state moves in the new mode).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Jump:
    """Which state is the mode, what its values 0, 1, … are called, and how it jumps.

    chances(x, u, p, dt, out) fills `out` (modes,) with the probability of each mode `dt` seconds on, from the state x,
    its mode included. The mode's prior is that of its state: of two modes, the mean is the probability of the second;
    of more, that of a Gaussian at the whole numbers. f keeps the mode (out[mode] = x[mode]) and no noise acts on it. f
    and h must take any number for it, since filters that do not sample give them its mean.
    """

    state: str
    modes: tuple[str, ...]
    chances: Callable
