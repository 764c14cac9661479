"""What a command says on standard error: one line each, with control characters escaped."""

from __future__ import annotations

import sys

from estimators.errors import printable


def complain(text: object) -> None:
    """Say what is wrong."""
    print(f"nisus: {printable(str(text))}", file=sys.stderr, flush=True)
