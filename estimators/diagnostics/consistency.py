"""Whether a mean NIS is what it should be (normal_nis.py), in the same words wherever one is shown."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class NisVerdict(NamedTuple):
    """A mean NIS, the 95 % bounds that it should lie in, and whether these are what was normal when commissioned."""

    nis: float
    low: float
    high: float
    commissioned: bool

    @property
    def place(self) -> str:
        """`inside`, `above` or `below` the bounds; nothing where there is no NIS."""
        if not np.isfinite(self.nis + self.low + self.high):
            return ""
        return "below" if self.nis < self.low else "above" if self.nis > self.high else "inside"

    @property
    def expected(self) -> str:
        """The bounds in words, and what they are."""
        return f"its 95 % bounds {self.low:.3g} to {self.high:.3g}" + (", as commissioned" if self.commissioned else "")

    @property
    def words(self) -> str:
        """All of it in one line."""
        return f"mean NIS {self.nis:.3g}, {self.place} {self.expected}" if self.place else "no reading to judge"
