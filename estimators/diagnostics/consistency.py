"""Whether a mean NIS is what it should be (normal_nis.py), in the same words wherever one is shown."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class NisVerdict(NamedTuple):
    """A mean NIS, the 95 % bounds that it should lie in, and whether these are what was normal when commissioned.

    What was normal was taken from all readings, each row at most 6 σ (commission.py): `judged` is the mean NIS of the
    same, which is compared; NaN where it is the NIS itself.
    """

    nis: float
    low: float
    high: float
    commissioned: bool
    judged: float = np.nan

    @property
    def measure(self) -> float:
        """What is compared with the bounds."""
        return self.judged if np.isfinite(self.judged) else self.nis

    @property
    def place(self) -> str:
        """`inside`, `above` or `below` the bounds; nothing where there is no NIS."""
        if not np.isfinite(self.measure + self.low + self.high):
            return ""
        return "below" if self.measure < self.low else "above" if self.measure > self.high else "inside"

    @property
    def said(self) -> str:
        """Where it lies, and by what."""
        if not self.place:
            return "no reading to judge"
        bounds = f"{self.place} its 95 % bounds {self.low:.3g} to {self.high:.3g}"
        own = abs(self.measure - self.nis) < 0.005 * self.nis
        clipped = "" if own else f"{self.measure:.3g} with those refused and none beyond 6 σ, "
        return clipped + bounds + (", as commissioned" if self.commissioned else "")

    @property
    def words(self) -> str:
        """All of it in one line."""
        return f"mean NIS {self.nis:.3g}, {self.said}" if self.place else self.said
