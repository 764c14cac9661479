"""The cards of the gallery: what each twin is and teaches, and whether it can run here."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from config.loader import find, load, shipped
from estimators.errors import NisusError

from ..twin.missing import missing
from ..twin.twin import Twin, load_twin
from .pictures import picture_file

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
    scene: str = ""
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
        twin = load_twin(name)
    except (NisusError, OSError) as error:
        return Card(name, _title(name), error=str(error).splitlines()[0])
    return card_of(name, twin)


def card_of(name: str, twin: Twin) -> Card:
    """The card of a twin that is put together."""
    config = twin.config
    return Card(
        name=name,
        title=twin.title,
        question=config.question,
        teaches=config.teaches,
        source=KINDS[config.source.type],
        states=twin.model.nx,
        rows=len(twin.model.row_names),
        estimator=twin.estimator,
        scene=config.view.scene.kind,
        log=config.source.type != "simulator",
        picture=picture_file(find(name)).is_file(),
        missing=missing(twin.loaded),
    )


def _title(name: str) -> str:
    try:
        return load(name).config.title or Path(name).stem
    except (NisusError, OSError):
        return Path(os.fspath(name)).stem
