"""`nisus twins`: the twins that ship, or what one of them is, what to expect of it, and how each filter scored."""

from __future__ import annotations

from itertools import takewhile
from typing import TYPE_CHECKING

from config.loader import Loaded, load, shipped

from .compare_table import printed
from .scores import read_scores

if TYPE_CHECKING:
    from .arguments import Twins as Arguments


def show_twins(arguments: Arguments) -> int:
    """Carry the command out."""
    if arguments.name is None:
        for name in shipped():
            print(f"{name:<16} {load(name).config.title or ''}")
        return 0
    loaded = load(arguments.name)
    print("\n".join(described(loaded)))
    return 0


def described(loaded: Loaded) -> list[str]:
    """A twin in lines of text: title, the comment at the head of its YAML, and its scores."""
    name = loaded.path.stem
    head = takewhile(lambda line: line.startswith("#"), loaded.text.splitlines())
    prose = [line.removeprefix("#").removeprefix(" ") for line in head]
    scores = read_scores(loaded.path)
    table = printed(name, scores) if scores else [f"No scores yet; to write them: nisus compare {name} --write"]
    parts = [[f"{name}: {loaded.config.title}" if loaded.config.title else name], prose, table]
    return [line for part in parts if part for line in (*part, "")][:-1]
