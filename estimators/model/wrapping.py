"""What models made from other models share: their functions called by compiled wrappers, and noise."""

from __future__ import annotations

import hashlib
import inspect
import uuid
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..numerics.helpers import with_helpers
from ..numerics.jit import jit, plain
from .state_space import StateSpaceModel


@lru_cache(maxsize=256)
def as_inner(function: Callable) -> Any:
    """Compile a model's function for a wrapper to call, under a name by which Numba's cache finds it again.

    The cache tells closures apart by what they hold, and a compiled function by an identifier that is random in every
    process; one made from the source finds the code that another process compiled, and never code of another source.
    """
    python = with_helpers(plain(function))
    inner = jit(python)
    file = inspect.getsourcefile(python)
    source = Path(file).read_bytes() if file and Path(file).is_file() else uuid.uuid4().bytes
    key = hashlib.sha256(source + f"{python.__module__}.{python.__qualname__}".encode()).hexdigest()
    inner._set_uuid(str(uuid.UUID(key[:32])))
    return inner


def noise_function(model: StateSpaceModel) -> Callable:
    """Return the model's Q, or one that adds each noise to the states of its name."""
    if model.Q is not None:
        return model.Q
    return _white_noise(tuple((k, j) for k, item in enumerate(model.noises) for j in model.acts_on(item.name)))


@lru_cache(maxsize=64)
def _white_noise(acts_on: tuple[tuple[int, int], ...]) -> Callable:
    pairs = np.array(acts_on, np.int64).reshape(-1, 2)

    def Q(x, u, p, q, dt, out):  # noqa: ANN001, ANN202
        for i in range(pairs.shape[0]):
            out[pairs[i, 1], pairs[i, 1]] += q[pairs[i, 0]] * dt

    return Q
