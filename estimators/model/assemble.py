"""Assemble a model from its physics and the additions of a twin.

The order is fixed, and each step wraps the model of the step before:

1. `hybrid`: a learned correction beside f, with a noise for each corrected state.
2. `coloured`: states for process noise and sensor errors with a correlation time; correlation times are parameters.
3. `joint`: parameters, those of step 2 included, as the last states.

So the physics keeps its states first, in their order: x = (physics, disturbances, sensor errors, parameters).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from ..errors import ModelError
from .coloured import ColouredError, coloured
from .hybrid import LearnedCorrection, hybrid
from .joint import JointParameter, joint
from .state_space import StateSpaceModel


class AppendError(ModelError):
    """An addition that the model cannot have; `part` is its kind (learned, noise, error, estimate) and its name."""

    def __init__(self, part: tuple[str, str], message: str) -> None:
        super().__init__(message)
        self.part = part


def assemble(
    model: StateSpaceModel,
    *,
    learned: LearnedCorrection | None = None,
    noises: Mapping[str, float] | None = None,
    errors: Mapping[str, ColouredError] | None = None,
    estimated: Mapping[str, JointParameter] | None = None,
) -> StateSpaceModel:
    """Return the model with everything appended.

    Args:
        model: The physics; variances of its noises are the steady state of coloured ones.
        learned: A correction of its f.
        noises: Correlation time in seconds, by process noise.
        errors: Coloured errors, by sensor.
        estimated: Parameters to estimate, by name.

    Raises:
        AppendError: If something cannot be appended, with the part at fault.
    """
    noises, errors, estimated = noises or {}, errors or {}, estimated or {}
    if learned is not None:
        with _blamed("learned", ""):
            model = hybrid(model, learned)
    # Each alone first, so that an error names the one at fault.
    for name, over in noises.items():
        with _blamed("noise", name):
            coloured(model, {name: over})
    for name, error in errors.items():
        with _blamed("error", name):
            coloured(model, errors={name: error})
    model = coloured(model, noises, errors)
    for name, parameter in estimated.items():
        with _blamed("estimate", name):
            joint(model, {name: parameter})
    return joint(model, estimated)


@contextmanager
def _blamed(kind: str, name: str) -> Iterator[None]:
    try:
        yield
    except ModelError as error:
        raise AppendError((kind, name), str(error)) from None
