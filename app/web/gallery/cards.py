"""Where a twin's picture for the gallery is kept: those of twins that ship in a folder of their own."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from config.loader import TWINS, Loaded, find, load, shipped
from estimators.errors import NisusError

from ...twin.source import missing
from ...twin.twin import load_twin
from ..running import Stamp, stamp_of

CARDS = TWINS.parent / "cards"
"""Folder of the pictures of the twins that ship."""


def picture_file(twin: Path) -> Path:
    """Where the picture of a twin's YAML is; it may be absent."""
    ships = twin.resolve().parent == TWINS.resolve()
    return CARDS / f"{twin.stem}.svg" if ships else twin.with_suffix(".svg")


KINDS = {"simulator": "simulated", "can": "CAN bus", "can_log": "recorded", "table": "recorded", "merged": "recorded"}
"""What a type of source is called on a card."""


@dataclass(frozen=True)
class Card:
    """One twin on the shelf.

    `name` is by what it is started: that of a twin that ships, or the path of a YAML file. `missing` says why it cannot
    run here, `error` what is wrong with its files. `log` is whether a log can be dropped on it.
    """

    name: str
    title: str
    question: str | None = None
    teaches: str | None = None
    source: str = ""
    states: int = 0
    rows: int = 0
    estimator: str = ""
    log: bool = False
    picture: bool = False
    missing: str | None = None
    error: str | None = None

    def json(self) -> dict[str, Any]:
        """As the page gets it."""
        return asdict(self)


def shelf(own: Iterable[str] = ()) -> list[Card]:
    """The user's own twins, then those that ship, from the smallest state to the largest."""
    ships = [card(name) for name in shipped()]
    return [*map(card, own), *sorted(ships, key=lambda item: (item.states, item.source, item.name))]


def card(name: str) -> Card:
    """The card of a twin, whatever is wrong with it."""
    try:
        path = find(name)
        # A user's twin has a model of its own, which may change by itself.
        read = _read if name in shipped() else _read.__wrapped__
        found, loaded = read(name, stamp_of((path,)))
    except (NisusError, OSError) as error:
        return Card(name, _title(name), error=str(error).splitlines()[0])
    return replace(found, picture=picture_file(path).is_file(), missing=missing(loaded))


@lru_cache(maxsize=128)
def _read(name: str, stamp: Stamp) -> tuple[Card, Loaded]:
    """What a twin's files say, once for each time that they were saved."""
    twin = load_twin(name)
    config = twin.config
    found = Card(
        name=name,
        title=twin.title,
        question=config.question,
        teaches=config.teaches,
        source=KINDS[config.source.type],
        states=twin.model.nx,
        rows=len(twin.model.row_names),
        estimator=twin.estimator,
        log=config.source.type != "simulator",
    )
    return found, twin.loaded


def _title(name: str) -> str:
    try:
        return load(name).config.title or Path(name).stem
    except (NisusError, OSError):
        return Path(name).stem
