"""A package, because peers of the benchmarks install a `tests` of their own, which Python would find in its place."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
"""The checkout."""

# Read when NumPy is loaded. The threads of a small factorisation wait for each other by spinning, on processors that
# other tests need: one test took 36 s of a processor, and 7 s with one thread.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
