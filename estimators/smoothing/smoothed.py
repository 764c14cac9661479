"""What all readings say of the state at each event of a fold."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..fold import Fold
from ..track import Track


class Smoothed(NamedTuple):
    """Columns of one length N, as `Track` has them: mean, std (N, shown); cross (N, pairs)."""

    mean: np.ndarray
    std: np.ndarray
    cross: np.ndarray

    @staticmethod
    def room_for(fold: Fold) -> Smoothed:
        """Columns to be filled."""
        shape = fold.n, len(fold.model.shown)
        return Smoothed(np.empty(shape), np.empty(shape), np.empty((fold.n, len(fold.pairs))))

    def instead_of(self, track: Track) -> Track:
        """The fold's track with these moments in the place of its own."""
        return track._replace(mean=self.mean, std=self.std, cross=self.cross)
