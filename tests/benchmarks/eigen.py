"""The covariance update of the extended filter beside the same with fixed-size Eigen matrices in C++."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import numpy as np

from estimators.gaussian.ekf import project, updating
from estimators.gaussian.shared import downdate, factor, gain, joseph
from estimators.numerics.jit import borrowed, jit
from estimators.numerics.simd import scaled
from estimators.numerics.workspace import size_of, start_of

from .timing import BenchmarkRow, Bound, timed

REPETITIONS = 40_000
ROUNDS = 9
R = 0.04
FOLDERS = ("/usr/include/eigen3", "/usr/local/include/eigen3", "/opt/homebrew/include/eigen3")


@jit
def _update(repetitions, is_joseph, before, H, P, work):
    # As in the fold: reference-counted arrays cost more than the filter.
    before, H, P, work = borrowed(before), borrowed(H), borrowed(P), borrowed(work)
    m, n = H.shape
    own = updating(start_of(work), n, m)
    reading = own.reading
    for k in range(m):
        reading.d[k] = R
        for j in range(n):
            own.H[k, j] = H[k, j]
    for _ in range(repetitions):
        scaled(n * n, 1.0, before, P)
        project(P, own.H, n, reading.C, reading.S, reading.W)
        for k in range(m):
            reading.S[k, k] += R
        factor(reading.S, reading.chol_S, m, n)
        if is_joseph:
            gain(m, reading.C, reading.chol_S, n, own.K, reading.W)
            joseph(m, reading.d, reading.C, own.H, own.K, P, own.N, reading.W, reading.B)
        else:
            downdate(m, reading.C, reading.chol_S, n, P, reading.W)


def _ours(n: int, m: int, is_joseph: bool, repetitions: int) -> tuple[float, float]:
    """Return the trace of the result and the nanoseconds of an update, from the numbers of eigen.cpp."""
    i, k = np.arange(n), np.arange(m)
    before = np.eye(n) + 0.5 / (1.0 + abs(i[:, None] - i))
    H = np.sin(1.0 + 2.0 * k[:, None] + 3.0 * i)
    P, work = np.empty((n, n)), np.zeros(size_of(updating, n, m))
    _, spent = timed(lambda: _update(repetitions, is_joseph, before, H, P, work))
    return float(np.trace(P)), spent / repetitions * 1e9


def beside_eigen() -> Iterator[BenchmarkRow]:
    """P after a measurement of m rows, beside fixed-size Eigen matrices (g++ -O3 -march=native): ns, interleaved."""
    source = Path(__file__).with_name("eigen.cpp")
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "eigen"
        include = [f"-I{name}" for name in FOLDERS]
        done = subprocess.run(
            ["g++", "-O3", "-march=native", *include, str(source), "-o", str(program)], capture_output=True, text=True
        )
        if done.returncode:
            raise OSError(f"g++ cannot compile {source.name}; install Eigen, such as with apt install libeigen3-dev")
        pairs: dict[tuple[int, int, bool], list[tuple[float, float]]] = {}
        for _ in range(ROUNDS):
            lines = subprocess.run([program, str(REPETITIONS)], capture_output=True, text=True, check=True).stdout
            for line in lines.splitlines():
                size, rows, form, wanted, theirs = line.split()
                case = int(size), int(rows), form == "1"
                _ours(*case, 1)
                trace, spent = _ours(*case, REPETITIONS * 64 // case[0] ** 2)
                if not np.isclose(trace, float(wanted), rtol=1e-10):
                    raise ValueError(f"the traces differ: {trace} and {wanted}")
                pairs.setdefault(case, []).append((spent, float(theirs)))
    for (n, m, is_joseph), rounds in pairs.items():
        figures = {
            "Nisus [ns]": median(a for a, _ in rounds),
            "Eigen [ns]": median(b for _, b in rounds),
            "times": median(a / b for a, b in rounds),
        }
        name = f"{'Joseph form' if is_joseph else 'P - K S Kᵀ'} n={n} m={m}"
        yield BenchmarkRow(name, figures, (Bound("times", 1.0),))
