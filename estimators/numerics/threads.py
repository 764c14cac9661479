"""Whether loops over members may run on several threads here."""

from __future__ import annotations

import os
from functools import lru_cache

import numba


@lru_cache(maxsize=1)
def threaded() -> bool:
    """True if Numba's threads can be started from several Python threads at once (its OpenMP or TBB layer).

    Its third layer, `workqueue`, aborts the process when two folds use it at the same time; then, and on one core, the
    loops run on the caller's thread. The results are the same bits either way.

    The call also loads the layer, which machine code from the cache needs: without it LLVM ends the process.
    """
    from numba.np.ufunc.parallel import _launch_threads

    if "NUMBA_THREADING_LAYER" not in os.environ:
        numba.config.THREADING_LAYER = "threadsafe"
    try:
        _launch_threads()
    except ValueError:
        numba.config.THREADING_LAYER = "default"
        _launch_threads()
        return False
    return numba.threading_layer() in ("omp", "tbb") and numba.config.NUMBA_NUM_THREADS > 1
