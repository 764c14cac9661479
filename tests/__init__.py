"""A package, because peers of the benchmarks install a `tests` of their own, which Python would find in its place."""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
"""The checkout."""
