"""The source of a twin: its YAML section checked against the model, and opened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from config.extensions import maker
from config.loader import Loaded
from config.source_schema import AssetSection, CanLogSection, CanSection, RecordingSection, TableSection
from config.yaml_files import Key
from estimators.errors import SourceError
from estimators.log import READING, Events
from estimators.model.state_space import StateSpaceModel

from .channels import channels, read_faults
from .defaults import rhythm
from .sources.asset import SIMULATOR
from .sources.can import CAN, CAN_LOG
from .sources.kind import Kind, Opening, find_databases, find_recording
from .sources.push import PUSH, of_messages
from .sources.recordings import MERGED, TABLE

if TYPE_CHECKING:
    from sources.faults.kinds import Fault
    from sources.faults.layer import Faults
    from sources.source import Report, Source

KEY: Key = ("source",)

FIRST_EVENTS_S = 5.0  # Seconds between two looks for the first frames of a recording
MOST_EVENTS = 1_000_000  # Events of a table by which its rhythm is known; of a CAN log the first frames are enough


@dataclass(frozen=True)
class Plan:
    """A checked source section, ready to open; no file has been read."""

    loaded: Loaded
    model: StateSpaceModel
    log_files: tuple[Path, ...] | None
    brings_variances: bool = False
    """Whether some measurements come with their own noise."""
    scheduled: tuple[Fault, ...] = ()
    """Faults that the YAML injects into the source."""
    fed: tuple[int, ...] = ()
    """The sensors that the source feeds."""

    @property
    def kernels(self) -> tuple[str, ...]:
        """Compiled functions of the source; see `sources/pieces.py`."""
        return kind_of(self.loaded.config.source.type).kernels

    @property
    def recorded(self) -> bool:
        """Whether it is read from files, and so is neither a bus nor a simulation."""
        section = self.loaded.config.source
        live = section.type == "can" or (isinstance(section, TableSection) and section.follow)
        return kind_of(section.type).takes_log and (not live or self.log_files is not None)

    @cached_property
    def period(self) -> float | None:
        """The longest `rhythm` of the sensors of a recording, s, without those by chance unless all are; or None."""
        section, sensors, slowest = self.loaded.config.source, self.model.sensors, None
        steady = [k for k in self.fed if not sensors[k].by_chance] or self.fed
        parts = kind_of(section.type).sections(section, KEY) if self.recorded else {}
        if len(parts) > 1 and self.log_files is not None:
            return None
        for key, part in parts.items():
            opening = Opening(self.loaded, self.model, part, key, lambda *_: None, False, self.log_files)
            try:
                source = kind_of(part.type).open(opening)
            except SourceError:
                return None  # reported when the source is opened to be read
            most, batches = 1, iter(partial(source.read, FIRST_EVENTS_S), None)
            if hasattr(source, "as_recorded"):
                most, batches = MOST_EVENTS, source.as_recorded()
            read = [Events.empty(self.model.width)]
            try:
                while sum(map(len, read)) < most and (batch := next(batches, None)) is not None:
                    read.append(batch)
            except SourceError:
                continue
            finally:
                source.close()
            events = Events.concat(read, self.model.width)
            for sensor in steady:
                t = np.unique(events.t[events.of_sensor(sensor)])
                if t.size > 2:
                    slowest = max(slowest or 0.0, rhythm(t))
        return slowest

    def check_files(self) -> None:
        """Open the files of the source, and close them: it takes milliseconds, while its twin takes seconds to compile.

        Raises:
            SourceError: If one is absent or does not fit, with the remedy.
        """
        section = self.loaded.config.source
        opening = Opening(self.loaded, self.model, section, KEY, lambda *_: None, log_files=self.log_files)
        kind_of(section.type).files(opening)

    def faults(self) -> Faults:
        """Return a new layer of faults, with those of the YAML."""
        from sources.faults.layer import Faults

        section = self.loaded.config.source
        seed = section.seed if isinstance(section, AssetSection) else 0
        return Faults(self.model, self.scheduled, seed=seed)

    def open(
        self, report: Report, *, live: bool = True, speed: float | None = None, faults: Faults | None = None
    ) -> Source:
        """Open the source behind its faults.

        Args:
            report: Called as report(key, text) for counted events, from the source's thread.
            live: False asks for events that end: a recording in place of a bus.
            speed: Times real time, for a source that is not live; None is as fast as it is read.
            faults: A layer of `faults`, for a source that is opened again; None makes one.

        Raises:
            SourceError: If it cannot be opened, with the remedy.
        """
        from sources.faults.layer import FaultySource

        layer = self.faults() if faults is None else faults
        section = self.loaded.config.source
        opening = Opening(self.loaded, self.model, section, KEY, report, live=live, log_files=self.log_files)

        def bare() -> Source:
            source = kind_of(section.type).open(opening)
            try:
                layer.attach(source)
            except SourceError:
                source.close()
                raise
            return source

        source = bare()
        if speed is not None and not source.live:
            from sources.pacer import Pacer

            source.close()
            source = Pacer(bare, speed=speed)
        return FaultySource(source, layer)


def plan_source(loaded: Loaded, model: StateSpaceModel, log_files: Sequence[Path] | None) -> Plan:
    """Check the source's section against the model.

    Raises:
        ConfigError: With file and line, if it names what the model lacks.
        SourceError: If the source reads no recording and one was given.
    """
    section = loaded.config.source
    kind = kind_of(section.type)
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
    scheduled = _scheduled(loaded, model)
    own = any(item.accuracy is not None for item in found)
    fed_sensors = {item.index for item in found if item.kind == READING} if fed else range(len(model.sensors))
    files = tuple(log_files) if log_files is not None else None
    return Plan(loaded, model, files, own, scheduled, tuple(sorted(fed_sensors)))


def _scheduled(loaded: Loaded, model: StateSpaceModel) -> tuple[Fault, ...]:
    """Return the faults of the YAML that act on the source's events: those of a simulator, then those of the twin."""
    section = loaded.config.source
    simulated = isinstance(section, AssetSection) or (isinstance(section, CanSection) and section.asset is not None)
    found = read_faults(loaded, loaded.config.faults, ("faults",), model)
    for k, fault in enumerate(found):
        if fault.parameter is not None and not simulated:
            raise loaded.error(
                ("faults", k, "kind"),
                f"is {fault.kind}; it needs a simulated asset, and the source is a {section.type}",
            )
    if isinstance(section, AssetSection):
        found = [*read_faults(loaded, section.faults, (*KEY, "faults"), model), *found]
    return tuple(found)


def missing(loaded: Loaded) -> str | None:
    """Return a missing recording or DBC file, in one line with the remedy; None if all are present."""
    section = loaded.config.source
    try:
        for key, part in kind_of(section.type).sections(section, KEY).items():
            if isinstance(part, RecordingSection) and not (isinstance(part, TableSection) and part.follow):
                find_recording(loaded, part, key, None)
            if isinstance(part, CanSection | CanLogSection):
                find_databases(loaded, part, key)
    except SourceError as error:
        return str(error)
    return None


SOURCES: dict[str, Kind] = {
    "simulator": SIMULATOR,
    "can": CAN,
    "can_log": CAN_LOG,
    "table": TABLE,
    "merged": MERGED,
    "push": PUSH,
}
"""Those of the core, by the `type` of the section."""


@cache
def kind_of(name: str) -> Kind:
    """Return the kind of a source by the `type` of its section; those of extensions are imported on first use."""
    return SOURCES[name] if name in SOURCES else of_messages(maker("sources", name))
