"""The source of a twin: its YAML section checked against the model, and opened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from config.loader import Loaded
from config.yaml_lines import Key
from estimators.errors import SourceError
from estimators.log import READING
from estimators.model.state_space import StateSpaceModel

from .channels import channels
from .sources.can import make_player
from .sources.kind import Opening
from .sources.registry import SOURCES

if TYPE_CHECKING:
    from sources.can.player import Player
    from sources.source import Report, Source

KEY: Key = ("source",)


@dataclass(frozen=True)
class Plan:
    """What it takes to open the source; the YAML is checked, no file has been touched."""

    loaded: Loaded
    model: StateSpaceModel
    log_files: tuple[Path, ...] | None
    brings_variances: bool = False
    """Whether some sensor's readings tell their own noise."""

    def open(self, report: Report, *, live: bool = True) -> Source:
        """Open the source; `live` False takes a recording in place of a bus.

        Raises:
            SourceError: If it cannot be opened, with the remedy.
        """
        section = self.loaded.config.source
        opening = Opening(self.loaded, self.model, section, KEY, report, live=live, log_files=self.log_files)
        return SOURCES[section.type].open(opening)

    def player(self, report: Report, *, interface: str | None = None, channel: str | int | None = None) -> Player:
        """The twin's asset, ready to play on its bus, or on another one.

        Raises:
            SourceError: If the source is not a bus, it has no `asset`, or the bus cannot be opened.
        """
        return make_player(self.loaded, self.model, report, interface=interface, channel=channel)


def plan_source(loaded: Loaded, model: StateSpaceModel, log_files: Sequence[Path] | None) -> Plan:
    """Check the source's section against the model.

    Raises:
        ConfigError: With file and line, if it names what the model lacks.
        SourceError: If the source reads no recording and one was given.
    """
    section = loaded.config.source
    kind = SOURCES[section.type]
    if log_files is not None and not kind.takes_log:
        others = [name for name, other in SOURCES.items() if other.takes_log]
        raise SourceError(
            f"--log {log_files[0]}: the source of {loaded.config.name} is a {section.type}; --log needs type "
            f"{', '.join(others[:-1])} or {others[-1]}"
        )
    fed = kind.sections(section, KEY)
    found = [item for place, part in fed.items() for _, item in channels(loaded, part, place, model)]
    if fed and not any(item.kind == READING for item in found):
        names = ", ".join(model.sensor_names)
        raise loaded.error(KEY, f"feeds no sensor; name at least one of {names} under sensors")
    kind.check(loaded, model, section, KEY)
    own = any(item.accuracy is not None for item in found)
    return Plan(loaded, model, tuple(log_files) if log_files is not None else None, own)
