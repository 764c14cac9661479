"""End worker processes when their parent process ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from multiprocessing import parent_process
from threading import Thread

PR_SET_PDEATHSIG = 1
_PRCTL = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


def killed_with_parent() -> None:
    """Have the kernel kill this program when the thread that started it ends; the `preexec_fn` of a `Popen`.

    It only calls what was loaded before, as other threads of the parent may hold locks. Other systems than Linux have
    no such signal.
    """
    if _PRCTL is not None:
        _PRCTL(PR_SET_PDEATHSIG, signal.SIGKILL)


def leave_with_parent() -> None:
    """End this worker when its parent ends. A parent that is killed cannot notify workers, which would wait forever."""
    parent = parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    Thread(target=watch, name="parent", daemon=True).start()
