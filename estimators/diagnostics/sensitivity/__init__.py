"""Undetectable faults of a twin: sensitivities, minimal detectable faults, protection levels, observability."""

from .gramian import Gramian, GramianView, gramian
from .responses import Nudge, Response
from .sensitivity import Bound, Sensitivity, Smallest, bounds_of, sensitivity, smallest_of

__all__ = [
    "Bound", "Gramian", "GramianView", "Nudge", "Response", "Sensitivity", "Smallest", "bounds_of", "gramian",
    "sensitivity", "smallest_of",
]  # fmt: skip
