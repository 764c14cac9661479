"""What a command says on standard error: one line each, and nothing in it that a terminal would obey."""

from __future__ import annotations

import sys


def printable(text: str) -> str:
    """The text with everything escaped that is not shown as it is: bytes of a file must not reach the terminal."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def complain(text: object) -> None:
    """Say what is wrong."""
    print(f"nisus: {printable(str(text))}", file=sys.stderr, flush=True)
