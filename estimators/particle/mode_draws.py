"""Draws of a discrete mode for filters whose particles carry one (see model/jump.py)."""

from __future__ import annotations

import math

import numpy as np

from ..compiled.context import jump_chances
from ..numerics.jit import jit
from ..numerics.random import GAMMA, mix, unit, word

_JUMP = np.uint64(0x9FB21C651E98DF25)
"""Sets the jumps' words apart from the noise of the same key."""


@jit
def jump_key(key):
    """Where the words of the jumps start that go with the noise of `key`."""
    return mix((key ^ _JUMP) + GAMMA)


@jit
def jump(context, x, u, dt, key, member, chances):
    """Let the mode of one particle x jump, by word `member` of a `jump_key`; `chances` (n_modes,) is scratch.

    Chances that are no numbers leave the mode where it is.
    """
    jump_chances(context, x, u, dt, chances)
    total = 0.0
    for k in range(chances.size):
        total += chances[k]
    if not 0.0 < total < np.inf:
        return
    left = unit(word(key, np.uint64(member))) * total
    mode = 0
    while mode < chances.size - 1 and left >= chances[mode]:
        left -= chances[mode]
        mode += 1
    x[context.mode] = mode


@jit
def nearest_mode(context, value, mean, std):
    """The mode that a draw `value` of N(mean, std²) stands for, so that modes have the probabilities of a prior.

    Of two modes the second has the probability `mean`; of more, mode k has that of exp(-½ (k - mean)²/std²), in which
    the place of `value` in its distribution picks.
    """
    place = 0.5 * math.erfc(-(value - mean) / (math.sqrt(2.0) * max(std, 1e-12)))
    last = context.n_modes - 1
    if last == 1:
        return 1.0 if place > 1.0 - mean else 0.0
    total = 0.0
    for k in range(last + 1):
        total += math.exp(-0.5 * ((k - mean) / max(std, 0.1)) ** 2)
    left = place * total
    mode = 0
    while mode < last:
        left -= math.exp(-0.5 * ((mode - mean) / max(std, 0.1)) ** 2)
        if left < 0.0:
            break
        mode += 1
    return float(mode)


@jit
def any_mode(context, key, member):
    """A mode at random, each as likely as any other."""
    return float(min(int(unit(word(key, np.uint64(member))) * context.n_modes), context.n_modes - 1))
