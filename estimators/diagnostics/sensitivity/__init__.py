"""Undetectable faults of a twin: sensitivities, minimal detectable faults, protection levels, observability."""

from .gramian import Gramian, GramianView, gramian
from .responses import Nudge, Response
from .sensitivity import Bound, Sensitivity, Smallest, bounds_of, sensitivities, sensitivity, smallest_of, worse_faults

__all__ = [
    "Bound", "Gramian", "GramianView", "Nudge", "Response", "Sensitivity", "Smallest", "bounds_of", "gramian",
    "sensitivities", "sensitivity", "smallest_of", "worse_faults",
]  # fmt: skip
