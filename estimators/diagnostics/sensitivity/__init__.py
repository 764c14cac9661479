"""What could be wrong without anyone noticing: sensitivities, smallest visible faults, integrity, observability."""

from .bounds import Bound, Smallest, bounds_of, smallest_of
from .gramian import Gramian, View, gramian
from .nudges import Nudge
from .responses import Response
from .sensitivity import Sensitivity, sensitivity

__all__ = [
    "Bound", "Gramian", "Nudge", "Response", "Sensitivity", "Smallest", "View", "bounds_of", "gramian", "sensitivity",
    "smallest_of",
]  # fmt: skip
