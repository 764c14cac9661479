"""What could be wrong without anyone noticing: sensitivities, smallest visible faults, integrity, observability."""

from .gramian import Gramian, View, gramian
from .nudges import Nudge
from .responses import Response
from .sensitivity import Sensitivity, sensitivity

__all__ = ["Gramian", "Nudge", "Response", "Sensitivity", "View", "gramian", "sensitivity"]
