"""What could be wrong without anyone noticing: sensitivities, smallest visible faults, integrity, observability."""

from .nudges import Nudge
from .responses import Response
from .sensitivity import Sensitivity, sensitivity

__all__ = ["Nudge", "Response", "Sensitivity", "sensitivity"]
