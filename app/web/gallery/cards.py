"""Cards of the gallery: title, source, error and picture of each twin."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from config.channels import MessagesSection
from config.loader import TWINS, Loaded, find, load, shipped
from config.tunings import ships
from estimators.errors import NisusError
from estimators.model.state_space import StateSpaceModel

from ...twin.source import missing
from ...twin.twin import Twin, load_twin
from ..running import Stamp, stamp_of

CARDS = TWINS.parent / "cards"
"""Folder of pictures of the bundled twins."""


def picture_file(twin: Path) -> Path:
    """Return the path of a twin's picture; it may be absent."""
    return CARDS / f"{twin.stem}.svg" if ships(twin) else twin.with_suffix(".svg")


KINDS = {"simulator": "simulated", "can": "CAN bus"}
"""Names of source types on a card; any other is of messages, or recorded."""


@dataclass(frozen=True)
class Card:
    """One twin of the gallery.

    `name` is that of a bundled twin, or the path of a YAML file. `missing` is why it cannot run here, `error` a fault
    in its files, `log` whether a log can be dropped on it.
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


def shelf(own: Iterable[str] = ()) -> list[Card]:
    """Return cards of the user's own twins, then of bundled ones, by number of states."""
    bundled = [card(name) for name in shipped()]
    return [*map(card, own), *sorted(bundled, key=lambda item: (item.states, item.source, item.name))]


def card(name: str) -> Card:
    """Return the card of a twin, also if its files have errors."""
    try:
        path = find(name)
        # A user's twin has a model of its own, which may change by itself.
        read = _read if name in shipped() else _read.__wrapped__
        found, loaded, _ = read(name, stamp_of((path,)))
    except (NisusError, OSError) as error:
        return Card(name, _title(name), error=str(error).splitlines()[0])
    return replace(found, picture=picture_file(path).is_file(), missing=missing(loaded))


def readable_twins(names: Iterable[str]) -> Iterator[tuple[Card, Loaded, StateSpaceModel]]:
    """Yield card, configuration and model of the twins whose files have no error."""
    for name in names:
        with suppress(NisusError, OSError):
            yield _read(name, stamp_of((find(name),)))


@lru_cache(maxsize=128)
def _read(name: str, stamp: Stamp) -> tuple[Card, Loaded, StateSpaceModel]:
    """Read a twin's files, once for each time that they were saved."""
    twin = load_twin(name)
    return card_of(name, twin), twin.loaded, twin.model


def card_of(name: str, twin: Twin) -> Card:
    """Return the card of a twin that was read, without its picture."""
    config = twin.config
    return Card(
        name=name,
        title=twin.title,
        question=config.question,
        teaches=config.teaches,
        source=KINDS.get(config.source.type, "messages" if isinstance(config.source, MessagesSection) else "recorded"),
        states=twin.model.nx,
        rows=len(twin.model.row_names),
        estimator=twin.estimator,
        log=config.source.type not in ("simulator", "push"),
    )


def _title(name: str) -> str:
    try:
        return load(name).config.title or Path(name).stem
    except (NisusError, OSError):
        return Path(name).stem
