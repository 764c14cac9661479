"""Blocks of time: a fit is made on some of them, and judged on the others, which it never saw.

One fold runs through all of them, since the state must come from somewhere; only which readings count differs. Every
reading is judged by its prediction from the readings before it (Dawid 1984, doi:10.2307/2981683), so that blocks held
out are predictions of data that took no part in the fit.
"""

from __future__ import annotations

import numpy as np

from ..log import READING, Log

BLOCKS = 9
"""Blocks of a log, if nobody says otherwise: every third of them is held out, the last one too."""

EVERY = 3


def held_out_rows(log: Log, blocks: int = BLOCKS, every: int = EVERY) -> np.ndarray:
    """Mask (n,) of the events in blocks that are held out; none where `blocks` is 0.

    The blocks are of one length in readings, so that each says as much, and the last is held out: what a fit is for
    lies after what it was made on.
    """
    reading = log.kind[: log.n] == READING
    count = int(reading.sum())
    if not blocks or count < blocks:
        return np.zeros(log.n, bool)
    # What comes after the last reading belongs to its block.
    block = np.minimum((np.cumsum(reading) - reading) * blocks // count, blocks - 1)
    held: np.ndarray = block % every == every - 1
    return held
