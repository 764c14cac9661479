"""Where machine code is kept. Without Numba, whose import takes long: to know that nothing is there needs none."""

from __future__ import annotations

import hashlib
import os
from importlib.metadata import version
from pathlib import Path

CONSTANTS = ("errors.py", "batch.py", "state_space.py", "alarms.py", "hypotheses.py")
"""Files from which compiled code takes constants, and nothing else."""


def cache_folder() -> Path:
    """Where machine code is kept: per user, and apart for each version of the sources.

    Numba looks only at the file of the function it compiles, not at those that the function calls, or takes a constant
    from; so the sources of the package that have to do with compiling are part of the path, and an edit to any of them
    compiles all anew. The models that ship are left out: each is compiled by itself.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    digest = hashlib.sha256(version("numba").encode())
    package = Path(__file__).parent.parent
    for path in sorted(package.rglob("*.py")):
        source = path.read_bytes()
        compiling = b"jit" in source or b"intrinsic" in source or path.name in CONSTANTS
        if compiling and package / "models" not in path.parents:
            digest.update(source)
    return base / "nisus" / "numba" / digest.hexdigest()[:16]
