"""Compiled code in a process that finds it in the cache."""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from numba.core.targetconfig import ConfigStack
from numba.extending import intrinsic

from estimators.model.wrapping import as_inner
from estimators.numerics.cache_entries import EntryFiles
from estimators.numerics.jit import by_address, embedded, inner, inner_embedded, jit, linkable, linkable_embedded, part
from tests import ROOT
from tests.support import run_python

LOADED = """
from llvmlite.binding import address_of_symbol
from estimators.registry import ESTIMATORS
ESTIMATORS["kf"].code()
print(address_of_symbol("numba_parallel_for") is not None, address_of_symbol("allocate_sched") is not None)
"""


def test_code_from_the_cache_finds_the_threads_that_it_may_call():
    """What LLVM does not find when it loads such code ends the process, whatever filter came first."""
    assert run_python(LOADED).stdout.split() == ["True", "True"]


def drawn(cache) -> subprocess.CompletedProcess[str]:
    """Call two compiled functions in another process, with a cache of its own."""
    code = "from estimators.numerics.random import key_of, word; print(key_of(1, 2, 3), word(2**63, 2**63))"
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    return run_python(code, env=environment | {"XDG_CACHE_HOME": str(cache)})


def test_a_damaged_entry_is_discarded_and_compiled_again(tmp_path):
    """Files cut in half, and a machine code with one byte changed, which unpickling would not notice."""
    said = drawn(tmp_path)
    assert said.stderr == ""
    paths = sorted(tmp_path.rglob("*.nbc"))
    changed = [path for path in paths if "numerics/random.word" in str(path)]
    assert changed
    assert len(changed) < len(paths)
    for path in paths:
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content if path in changed else content[: len(content) // 2])
    again = drawn(tmp_path)
    assert again.stdout == said.stdout
    (line,) = again.stderr.splitlines()
    assert line.endswith("damaged entries of the compile cache discarded; compiling them again")
    assert drawn(tmp_path).stderr == ""


def test_entries_saved_at_once_are_kept_apart(tmp_path):
    """Closures of one function differ in their key alone; processes that compile them save them at the same time."""
    keys = [("float64", ("cpu", "features"), ("code", f"cell {i}")) for i in range(200)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda key: EntryFiles(str(tmp_path), "f-1", "stamp").save(key, f"code of {key}"), keys))
    assert [EntryFiles(str(tmp_path), "f-1", "stamp").load(key) for key in keys] == [f"code of {key}" for key in keys]
    assert keys[0] in EntryFiles(str(tmp_path), "f-1", "stamp")
    edited = EntryFiles(str(tmp_path), "f-1", "stamp of an edited file")
    assert keys[0] not in edited
    assert edited.load(keys[0]) is None


PARTS = """
import sys
from estimators.numerics.jit import jit, part

@part
def cubed(x):
    return x * x * x

@jit
def one(x):
    return 1.0 + cubed(x)

@jit
def two(x):
    return 2.0 + cubed(x)

print({"one": one, "two": two}[sys.argv[1]](3.0))
"""


def test_a_part_has_no_machine_code_of_its_own_and_is_linked_from_the_cache(tmp_path):
    script = tmp_path / "parts.py"
    script.write_text(PARTS)
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    for name, expected in (("one", "28.0"), ("two", "29.0")):
        run = subprocess.run(
            [sys.executable, script, name], env=environment, capture_output=True, text=True, check=True
        )
        assert (run.stdout.strip(), run.stderr) == (expected, "")
        # The entry of the first process serves the second.
        (cubed,) = tmp_path.rglob("*cubed*.nbc")
        (whole,) = tmp_path.rglob(f"*.{name}-*.nbc")
        assert [b"\x7fELF" in path.read_bytes() for path in (cubed, whole)] == [False, True]


CLOSURES = """
import math
from estimators.model.wrapping import as_inner
from estimators.numerics.jit import jit

def made(power):
    def sums(values):
        total = 0.0
        for i in range(values.size):
            total += SUMMANDS
        return total

    inner = as_inner(sums)

    @jit
    def outer(values):
        return inner(values) + inner(2.0 * values) + inner(values + 1.0)

    return outer
""".replace("SUMMANDS", " + ".join(f"math.sin({k}.0 * values[i]) / ({k}.0 + power)" for k in range(1, 60)))
"""An inner function that is too long for LLVM to copy it into the outer one."""


def test_closures_that_two_processes_compiled_are_told_apart_by_a_third(tmp_path):
    """Their inner functions have the same name; the linker of a process keeps one function of a name."""
    (tmp_path / "closures.py").write_text(CLOSURES)

    def run(*powers: int) -> list[float]:
        code = f"import numpy as np, closures; print(*[closures.made(k)(np.linspace(1, 2, 5)) for k in {powers}])"
        environment = os.environ | {"PYTHONPATH": f"{ROOT}:{tmp_path}", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        return [float(value) for value in run_python(code, env=environment).stdout.split()]

    (one,), (two,) = run(2), run(4)
    assert one != two
    assert run(2, 4) == [one, two]


LINKED = """
from estimators.numerics.jit import f64, jit, linkable

@linkable
def inner(a):
    return 3.0 * a

@jit
def outer(a):
    return inner(a) + 1.0
"""


def printed(folder: Path, code: str) -> list[str]:
    """What a process prints that has `LINKED` as a module `linked`, and the cache of the processes before it."""
    (folder / "linked.py").write_text(LINKED)
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{folder}", "NUMBA_CACHE_DIR": str(folder / "cache")}
    return run_python(code, env=environment).stdout.split()


def test_code_from_the_cache_needs_no_tables_of_numba_and_is_linked_into_new_code(tmp_path):
    """`numba.np.linalg` is imported with the tables, which fill when something is compiled."""

    def run(code: str) -> list[str]:
        return printed(tmp_path, f"import sys, linked; filled = lambda: 'numba.np.linalg' in sys.modules; {code}")

    assert run("linked.inner.compile((linked.f64,)); print(linked.inner(2.0), filled())") == ["6.0", "True"]
    found = "print(linked.inner(2.0), filled(), linked.outer(2.0), linked.inner.stats.cache_hits.total(), filled())"
    assert run(found) == ["6.0", "False", "7.0", "1", "True"]


def test_a_caller_links_a_function_without_machine_code_of_its_own(tmp_path):
    """The entries of both forms are in the cache at once, and the other form runs in Python from there."""

    def run(code: str) -> list[str]:
        return printed(tmp_path, f"from linked import inner, outer; {code}")

    assert run("print(outer(2.0), len(inner.overloads), len(inner.linked.overloads))") == ["7.0", "0", "1"]
    assert run("print(inner(2.0), inner.stats.cache_hits.total())") == ["6.0", "0"]
    hits = "inner.stats.cache_hits.total(), inner.linked.stats.cache_hits.total()"
    assert run(f"print(inner(2.0), outer(2.0), {hits})") == ["6.0", "7.0", "1", "0"]
    assert len(list((tmp_path / "cache").rglob("linked.inner*.nbc"))) == 2


KINDS = [
    *((kind, False) for kind in (jit, linkable, part, inner)),
    *((kind, True) for kind in (embedded, linkable_embedded, inner_embedded)),
]


@pytest.mark.parametrize(("kind", "copied"), KINDS)
@pytest.mark.parametrize("caller", [embedded, jit])
def test_what_llvm_must_copy_does_not_follow_from_the_first_caller(kind, copied, caller):
    """Numba hands `forceinline` on to what it compiles for a caller, and the cache keeps that for all others."""
    flags, new = [], float(time.time_ns())  # A number of its own in the closure: it is not in the cache.

    @intrinsic
    def note(typing_context, a):
        flags.append(ConfigStack().top().forceinline)
        return a(a), lambda context, builder, signature, given: given[0]

    @kind
    def within(a):
        return note(a) + new

    @caller
    def first(a):
        return within(a)

    @jit
    def outer(a):
        return first(a) + new

    assert outer(1.0) == 1.0 + 2.0 * new
    assert set(flags) == {copied}


def test_a_function_within_others_runs_in_python_as_it_is_written():
    """Numba knows no `hex`. Checks of a model call its functions, each of which was compiled for that alone."""
    assert as_inner(lambda a: a.hex())(1.0) == "0x1.0000000000000p+0"


def test_a_function_for_addresses_names_its_python_form_when_called():
    """Without the wrapper a call from Python would end the process."""

    def twice(a):
        return 2.0 * a

    made = by_address(twice)
    with pytest.raises(TypeError, match="twice is called by compiled code only; call its `py_func`"):
        made(1.0)
    assert made.py_func(1.0) == 2.0
