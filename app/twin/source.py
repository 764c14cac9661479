"""The source of a twin: its YAML section turned into channels and an open source."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from config.loader import Loaded
from config.source_schema import (
    AssetSection,
    CanLogSection,
    CanSection,
    MergedSection,
    ProfileSection,
    SimulatorSection,
    TableSection,
)
from config.yaml_lines import Key, dotted
from estimators.errors import NisusError, SourceError, nearest
from estimators.log import READING, Readings
from estimators.model.state_space import StateSpaceModel

from .channels import channels
from .files import failure, find_databases, find_recording
from .model import check_names, find_model, one_each

if TYPE_CHECKING:
    from sources.can.player import Player
    from sources.simulation.faults import Fault
    from sources.simulation.profile import Profile
    from sources.source import Channel, Report, Source

MOST_EVENTS = 1e8
"""That a simulation may make; it makes some ten thousand a second."""

WITHOUT_END = 100.0
"""Seconds within which one without end may make that many."""

TABLES = (".csv", ".parquet", ".pq", ".mat", ".npz")
"""File endings that `--log` gives to the tables of a merged source."""


@dataclass(frozen=True)
class Plan:
    """What it takes to open the source; the YAML is checked, no file has been touched."""

    loaded: Loaded
    model: StateSpaceModel
    log_files: tuple[Path, ...] | None

    def open(self, report: Report, *, live: bool = True) -> Source:
        """Open the source; `live` False takes a recording in place of a bus.

        Raises:
            SourceError: If it cannot be opened, with the remedy.
        """
        section = self.loaded.config.source
        key: Key = ("source",)
        if isinstance(section, SimulatorSection):
            return self.simulator(section, key)
        if isinstance(section, MergedSection):
            return self._merged(section, key, report)
        if isinstance(section, CanSection) and self.log_files is None and live:
            return self._bus(section, key, report)
        return self._recording(section, key, report, self.log_files)

    def simulator(self, section: AssetSection, key: Key) -> Any:
        """The simulated asset."""
        from sources.simulation.simulator import SensorPlan, Simulator

        truth = section.truth
        truth_model = find_model(self.loaded, (*key, "truth", "model"), truth.model) if truth.model else None
        if truth_model is not None:
            _check_same(self.loaded, (*key, "truth", "model"), truth_model, self.model)
            _check_truth(self.loaded, section, key, truth_model)
        plans = {}
        for sensor in self.model.sensors:
            plan = section.sensors.get(sensor.name)
            if plan is None:
                continue
            variances = plan.variances
            if variances is not None:
                place = (*key, "sensors", sensor.name, "std" if plan.std is not None else "variance")
                variances = one_each(self.loaded, place, variances, [row.name for row in sensor.rows])
            plans[sensor.name] = SensorPlan(every=plan.every, variances=variances, drop_every=plan.drop_every)
        return Simulator(
            self.model,
            seed=section.seed,
            step=section.step,
            duration=section.duration,
            initial=dict(section.initial),
            truth_parameters=dict(truth.parameters),
            truth_model=truth_model,
            truth_noise={name: level.value for name, level in truth.noise.items()},
            inputs={name: _profile(profiles) for name, profiles in section.inputs.items()},
            sensors=plans,
            faults=_faults(self.loaded, section, key, self.model),
            truth_every=truth.every if self.model.grid is not None else None,
        )

    def player(self, report: Report, *, interface: str | None = None, channel: str | int | None = None) -> Player:
        """The twin's asset, ready to play on its bus, or on another one.

        Raises:
            SourceError: If the source is no bus, it has no `asset`, or the bus cannot be opened.
        """
        from sources.can.player import Player

        section, key = self.loaded.config.source, ("source",)
        if not isinstance(section, CanSection):
            raise failure(
                self.loaded, key, f"is of type {section.type}; only one of type can has a bus to play an asset on"
            )
        if section.asset is None:
            raise failure(self.loaded, key, "has no asset to play; describe one under source.asset")
        same = interface in (None, section.interface)
        return Player(
            self.simulator(section.asset, (*key, "asset")),
            find_databases(self.loaded, section, key),
            [item for _, item in channels(self.loaded, section, key, self.model)],
            interface=interface or section.interface,
            channel=section.channel if channel is None else channel,
            bus_options=dict(section.options) if same else {},
            report=report,
        )

    def _bus(self, section: CanSection, key: Key, report: Report) -> Source:
        from sources.can.bus import CanBus

        decoder = self._decoder(section, key, report)
        bus = CanBus(section.interface, section.channel, decoder, bus_options=dict(section.options), report=report)
        if section.interface != "virtual" or section.asset is None:
            return bus
        # Nobody outside this process could speak on it. The listener is there first, so it hears the first frame.
        try:
            return PlayedBus(bus, self.player(report))
        except NisusError:
            bus.close()
            raise

    def _recording(self, section: Any, key: Key, report: Report, log_files: Sequence[Path] | None) -> Source:
        files = find_recording(self.loaded, section, key, log_files)
        if isinstance(section, TableSection):
            from sources.tables.table import Table

            return self._blamed(
                section,
                key,
                lambda channels: Table(
                    files,
                    time_column=section.time.column,
                    time_unit=section.time.unit,
                    time_shift=section.time.shift,
                    channels=channels,
                    width=self.model.width,
                    report=report,
                    horizon=self.loaded.config.time.horizon,
                ),
            )
        from sources.can.log import CanLog

        decoder = self._decoder(section, key, report)
        try:
            return CanLog(files, decoder, report=report)
        except SourceError as error:
            if log_files is not None:
                raise
            where = "recording" if isinstance(section, CanSection) else "files"
            raise _about(self.loaded, (*key, where), str(error)) from None

    def _merged(self, section: MergedSection, key: Key, report: Report) -> Source:
        from sources.merged import Merged

        shares: list[list[Path] | None] = [None] * len(section.parts)
        if self.log_files is not None:
            shares = self._shares(section)
        parts = [
            self._recording(part, (*key, "parts", k), report, share)
            for k, (part, share) in enumerate(zip(section.parts, shares, strict=True))
            if share != []
        ]
        return Merged(parts)

    def _shares(self, section: MergedSection) -> list[list[Path] | None]:
        """Which part reads which of the `--log` files: by name, else tables to the table and logs to the CAN log."""
        shares: list[list[Path] | None] = [[] for _ in section.parts]
        for file in self.log_files or ():
            fits = [
                k
                for k, part in enumerate(section.parts)
                if any(fnmatch.fnmatch(file.name, Path(pattern).name) for pattern in part.files)
            ]
            if not fits:
                kind = TableSection if file.suffix.lower() in TABLES else CanLogSection
                fits = [k for k, part in enumerate(section.parts) if isinstance(part, kind)]
            if len(fits) != 1:
                raise SourceError(
                    f"--log {file}: {len(fits)} parts of {self.loaded.places.at(('source', 'parts'))} could read it; "
                    "give it the name of the file that it replaces"
                )
            share = shares[fits[0]]
            assert share is not None
            share.append(file)
        return shares

    def _decoder(self, section: CanSection | CanLogSection, key: Key, report: Report) -> Any:
        from sources.can.decoder import Decoder

        databases = find_databases(self.loaded, section, key)
        return self._blamed(
            section,
            key,
            lambda channels: Decoder(databases, channels, width=self.model.width, report=report),
        )

    def _blamed(self, section: Any, key: Key, build: Callable[[list[Channel]], Any]) -> Any:
        """Build with every channel; if that fails, find the one at fault and name its line."""
        named = channels(self.loaded, section, key, self.model)
        try:
            return build([channel for _, channel in named])
        except SourceError as error:
            reason = str(error)
        try:
            build([])
        except SourceError as error:
            if str(error) == reason:  # No channel's fault: a file, or the column that tells the time.
                raise _about(self.loaded, key, reason) from None
        for place, channel in named:
            try:
                build([channel])
            except SourceError as error:
                raise _about(self.loaded, place, str(error).removeprefix(f"{channel.name}: ")) from None
        raise _about(self.loaded, key, reason)


def _about(loaded: Loaded, key: Key, text: str) -> SourceError:
    """What a source says of itself, with the place in the YAML that it concerns."""
    return SourceError(f"{loaded.places.at(key)}: {dotted(key)}: {text}")


class PlayedBus:
    """A bus inside this process, and the asset that speaks on it."""

    live = True

    def __init__(self, bus: Source, player: Player) -> None:
        self._bus = bus
        self._player = player
        player.start()

    def read(self, timeout: float) -> Readings | None:
        """The next events of the bus."""
        return self._bus.read(timeout)

    def now(self) -> int | None:
        """The bus's time, ns."""
        return self._bus.now()

    def close(self) -> None:
        """Silence the asset, then leave the bus."""
        self._player.close()
        self._bus.close()


def plan_source(loaded: Loaded, model: StateSpaceModel, log_files: Sequence[Path] | None) -> Plan:
    """Check the source's section against the model.

    Raises:
        ConfigError: With file and line, if it names what the model lacks.
        SourceError: If the source reads no recording and one was given.
    """
    section = loaded.config.source
    key: Key = ("source",)
    plan = Plan(loaded, model, tuple(log_files) if log_files is not None else None)
    if isinstance(section, SimulatorSection):
        if log_files is not None:
            raise SourceError(
                f"--log {log_files[0]}: the source of {loaded.config.name} is a simulator; --log needs type can, "
                "can_log, table or merged"
            )
        _check_asset(loaded, section, key, model)
        return plan
    parts: dict[Key, Any] = {key: section}
    if isinstance(section, MergedSection):
        parts = {(*key, "parts", k): part for k, part in enumerate(section.parts)}
    found = [item for place, part in parts.items() for _, item in channels(loaded, part, place, model)]
    if not any(item.kind == READING for item in found):
        names = ", ".join(model.sensor_names)
        raise loaded.error(key, f"feeds no sensor; name at least one of {names} under sensors")
    if isinstance(section, CanSection) and section.asset is not None:
        _check_asset(loaded, section.asset, (*key, "asset"), model)
    return plan


def _check_asset(loaded: Loaded, section: AssetSection, key: Key, model: StateSpaceModel) -> None:
    check_names(loaded, (*key, "initial"), section.initial, model.state_names, "state", model)
    check_names(loaded, (*key, "inputs"), section.inputs, model.input_names, "input", model)
    check_names(loaded, (*key, "sensors"), section.sensors, model.sensor_names, "sensor", model)
    _faults(loaded, section, key, model)
    _check_length(loaded, section, key, model)
    if section.truth.model is None:
        _check_truth(loaded, section, key, model)


def _check_length(loaded: Loaded, section: AssetSection, key: Key, model: StateSpaceModel) -> None:
    """Refuse a simulation that would not end, or not get on, in a person's time."""
    step, duration = section.step, section.duration
    seconds = max(WITHOUT_END, step) if duration is None else max(duration, step)
    plans = [section.sensors.get(sensor.name) for sensor in model.sensors]
    readings = sum(1.0 / (plan.every if plan else 1) for plan in plans)
    runs = max(1.0, step / model.max_step)
    count = seconds / step * max(runs, readings)
    if count <= MOST_EVENTS:
        return
    other = dotted((*key, "duration"))
    if duration is None:
        name, value, remedy = "step", step, "shorten it" if runs > readings else "lengthen it"
    elif step < 1.0 / duration:
        name, value, remedy = "step", step, f"lengthen it, or shorten {other}"
    else:
        name, value, remedy = "duration", duration, f"shorten it, or lengthen {dotted((*key, 'step'))}"
    raise loaded.error(
        (*key, name),
        f"is {value:g} s; the simulator would make {count:.3g} {'steps of f' if runs > readings else 'events'} in "
        f"{seconds:g} s, and may make {MOST_EVENTS:.0e}; {remedy}",
    )


def _check_truth(loaded: Loaded, section: AssetSection, key: Key, model: StateSpaceModel) -> None:
    """`model` is the asset's: the twin's own, or truth.model."""
    truth = section.truth
    parameters, noises = [item.name for item in model.parameters], [item.name for item in model.noises]
    check_names(loaded, (*key, "truth", "parameters"), truth.parameters, parameters, "parameter", model)
    check_names(loaded, (*key, "truth", "noise"), truth.noise, noises, "noise", model)


def _check_same(loaded: Loaded, key: Key, truth: StateSpaceModel, model: StateSpaceModel) -> None:
    for what in ("state_names", "input_names", "row_names"):
        theirs, ours = getattr(truth, what), getattr(model, what)
        if theirs != ours:
            raise loaded.error(
                key, f"has {what.replace('_names', 's')} {', '.join(theirs)}; they must be {', '.join(ours)}"
            )


def _faults(loaded: Loaded, section: AssetSection, key: Key, model: StateSpaceModel) -> list[Fault]:
    from sources.simulation.faults import Fault

    for k, item in enumerate(section.faults):
        place = (*key, "faults", k)
        if item.sensor not in model.sensor_names:
            near = nearest(item.sensor, model.sensor_names)
            raise loaded.error((*place, "sensor"), f"is {item.sensor!r}, no sensor of {model.name}; {near}")
        rows = [row.name for row in model.sensors[model.sensor_names.index(item.sensor)].rows]
        if item.row is not None and item.row not in rows:
            raise loaded.error((*place, "row"), f"is {item.row!r}, no row of {item.sensor}; {nearest(item.row, rows)}")
    return [
        Fault(
            item.sensor,
            item.kind,
            item.start,
            inf if item.end is None else item.end,
            item.size or 0.0,
            1.0 if item.rate is None else item.rate,
            item.row,
        )
        for item in section.faults
    ]


def _profile(sections: tuple[ProfileSection, ...]) -> Profile:
    """The sum of an input's profiles."""
    from sources.simulation.profile import Constant, Sine, Steps, Sum

    parts: list[Profile] = []
    for section in sections:
        if section.steps is not None:
            times, values = zip(*section.steps, strict=True)
            parts.append(Steps(times, values, section.repeat))
        elif section.sine is not None:
            sine = section.sine
            parts.append(Sine(sine.mean, sine.amplitude, sine.period, sine.phase))
        else:
            parts.append(Constant(section.constant or 0.0))
    return parts[0] if len(parts) == 1 else Sum(tuple(parts))
