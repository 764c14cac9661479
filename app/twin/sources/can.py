"""Sources of type can: a live bus, and the asset that may be played on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from config.loader import Loaded
from config.source_schema import CanSection
from config.yaml_files import Key
from estimators.errors import NisusError, SourceError
from estimators.log import Events
from estimators.model.state_space import StateSpaceModel
from sources.pieces import FRAMES, VALUES

from ..channels import channels, read_faults
from .asset import check_asset, make_asset
from .kind import Kind, Opening, blamed, closed, failure, find_databases, find_recording

if TYPE_CHECKING:
    from sources.can.decoder import Decoder
    from sources.can.player import Player
    from sources.faults.kinds import Change
    from sources.simulator import Simulator
    from sources.source import Report, Source


def _open(opening: Opening) -> Source:
    from sources.can.bus import CanBus

    if opening.log_files is not None or not opening.live:
        return open_can_log(opening)
    section: CanSection = opening.section
    report = opening.report
    decoder = make_decoder(opening)
    bus = CanBus(section.interface, section.channel, decoder, bus_options=dict(section.options), report=report)
    if section.interface != "virtual" or section.asset is None:
        return bus
    # Nobody outside this process could speak on it. The listener is there first, so it hears the first frame.
    try:
        asset, player = make_player(opening.loaded, opening.model, report)
        return PlayedBus(bus, player, asset)
    except NisusError:
        bus.close()
        raise


def _files(opening: Opening) -> object:
    """Check the recording in place of the bus, or the databases; the bus itself is opened once only."""
    return CAN_LOG.files(opening) if opening.log_files is not None else make_decoder(opening)


def _check(loaded: Loaded, model: StateSpaceModel, section: CanSection, key: Key) -> None:
    if section.asset is not None:
        check_asset(loaded, section.asset, (*key, "asset"), model)


def make_player(
    loaded: Loaded,
    model: StateSpaceModel,
    report: Report,
    *,
    interface: str | None = None,
    channel: str | int | None = None,
) -> tuple[Simulator, Player]:
    """Return the twin's simulated asset and its player, for its bus or another one.

    Raises:
        SourceError: If the source is not a bus, it has no `asset`, or the bus cannot be opened.
    """
    from sources.can.player import Player
    from sources.faults.layer import Faults, FaultySource

    section, key = loaded.config.source, ("source",)
    if not isinstance(section, CanSection):
        raise failure(loaded, key, f"is of type {section.type}; only one of type can has a bus to play an asset on")
    if section.asset is None:
        raise failure(loaded, key, "has no asset to play; describe one under source.asset")
    same = interface in (None, section.interface)
    place = (*key, "asset")
    asset = make_asset(loaded, model, section.asset, place)
    faults = Faults(
        model, read_faults(loaded, section.asset.faults, (*place, "faults"), model), seed=section.asset.seed
    )
    faults.attach(asset)
    player = Player(
        FaultySource(asset, faults),
        find_databases(loaded, section, key),
        [item for _, item in channels(loaded, section, key, model)],
        interface=interface or section.interface,
        channel=section.channel if channel is None else channel,
        bus_options=dict(section.options) if same else {},
        report=report,
    )
    return asset, player


class PlayedBus:
    """A bus inside this process, and the asset that speaks on it."""

    live = True

    def __init__(self, bus: Source, player: Player, asset: Simulator) -> None:
        self._bus = bus
        self._player = player
        self._asset = asset
        player.start()

    def read(self, timeout: float) -> Events | None:
        """Return the next events of the bus."""
        return self._bus.read(timeout)

    def now(self) -> int | None:
        """Return the bus's time, ns."""
        return self._bus.now()

    def change(self, parameter: str, factor: float, start: int | None = None, length: int | None = None) -> Change:
        """Change the asset; see `Simulator.change`. Times are those of the asset, from its start."""
        return self._asset.change(parameter, factor, start, length)

    def end(self, change: Change) -> None:
        """End a change with the asset's next step."""
        self._asset.end(change)

    def close(self) -> None:
        """Silence the asset, then leave the bus."""
        self._player.close()
        self._bus.close()


def make_decoder(opening: Opening) -> Decoder:
    """Return the decoder of the section's channels.

    Raises:
        SourceError: With file and line, if a database lacks a message or signal.
    """
    from sources.can.decoder import Decoder

    databases = find_databases(opening.loaded, opening.section, opening.key)
    width, report = opening.model.width, opening.report
    return blamed(opening, lambda channels: Decoder(databases, channels, width=width, report=report))


def open_can_log(opening: Opening) -> Source:
    """Open the recorded frames."""
    from sources.can.log import CanLog

    files = find_recording(opening.loaded, opening.section, opening.key, opening.log_files)
    decoder = make_decoder(opening)
    try:
        return CanLog(files, decoder, report=opening.report, zone=getattr(opening.section, "zone", None))
    except SourceError as error:
        if opening.log_files is not None:
            raise
        where = "recording" if isinstance(opening.section, CanSection) else "files"
        raise failure(opening.loaded, (*opening.key, where), str(error), ": ") from None


CAN_LOG = Kind(open_can_log, kernels=(FRAMES, VALUES), files=closed(open_can_log))
CAN = Kind(_open, check=_check, kernels=CAN_LOG.kernels, files=_files)
