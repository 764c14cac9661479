"""What a command says on standard error: one line each, and nothing in it that a terminal would obey."""

from __future__ import annotations

import sys

from estimators.errors import printable


def complain(text: object) -> None:
    """Say what is wrong."""
    print(f"nisus: {printable(str(text))}", file=sys.stderr, flush=True)
