"""Compiled code in a process that finds it in the cache."""

import subprocess
import sys

from tests.conftest import ROOT

LOADED = """
from llvmlite.binding import address_of_symbol
from estimators.registry import ESTIMATORS
ESTIMATORS["kf"].code()
print(address_of_symbol("numba_parallel_for") is not None, address_of_symbol("allocate_sched") is not None)
"""


def test_code_from_the_cache_finds_the_threads_that_it_may_call():
    """What LLVM does not find when it loads such code ends the process, whatever filter came first."""
    run = subprocess.run([sys.executable, "-c", LOADED], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["True", "True"]
