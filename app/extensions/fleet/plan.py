"""A fleet: its YAML, the twin of its assets, and their source."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.result import JsonObject
from app.twin.channels import channels
from app.twin.checks import check_receivers
from app.twin.secrets import secret
from app.twin.source import KEY, Plan, kind_of, plan_source
from app.twin.sources.kind import Opening, matching
from app.twin.twin import Twin, load_twin
from config.loader import shipped
from config.old_names import tell_older
from config.problems import check_section
from config.yaml_files import as_flow, read_text
from estimators.errors import ConfigError, EstimatorError
from estimators.fleet.fleet import Fleet
from sources.source import Report, Source
from sources.tables.text import column_of

from .one_asset import rows_of_asset
from .schema import FleetSection, FleetTableSection
from .tunings import AssetValues, asset_values

WINDOWS_S = (60, 300, 900, 3600, 21_600, 86_400)
"""Widths of the charts of an asset, s."""


@dataclass(frozen=True)
class FleetPlan:
    """A checked fleet; no file of its source has been read."""

    path: Path
    config: FleetSection
    twin: Twin
    """Twin of each asset, with the source of its own YAML."""
    source: Plan
    """Source of the fleet."""
    values: AssetValues
    """Names of the assets that are known before their measurements, and values of their tunings."""

    @property
    def name(self) -> str:
        """Short name."""
        return self.path.stem

    @property
    def ends(self) -> bool:
        """Whether the source ends."""
        section = self.config.source
        return isinstance(section, FleetTableSection) and not section.follow

    @property
    def reads_files(self) -> bool:
        """Whether its source is tables."""
        return isinstance(self.config.source, FleetTableSection)

    def fleet(self, assets: int, threads: int | None = None) -> Fleet:
        """Return an empty fleet of so many assets.

        Raises:
            EstimatorError: If the estimator is not for fleets.
        """
        twin, sensors = self.twin, np.arange(len(self.twin.model.sensors))
        expected = np.isin(sensors, () if self.ends else self.source.fed)  # as `Twin.expected`
        try:
            return Fleet(
                twin.estimator, twin.model, twin.tuning, assets=assets, values=self.values.padded(assets),
                policy=twin.policy, recent=self.config.late, threads=threads, expected=expected,
            )  # fmt: skip
        except EstimatorError as error:
            raise ConfigError(f"{self.source.loaded.places.at(('twin',))}: twin {twin.name}: {error}") from None

    def open(self, report: Report, *, stored: bool = False) -> Source:
        """Open the source, whose `read` returns `AssetEvents`.

        Args:
            report: Called for what cannot be used.
            stored: Whether the state of the fleet is kept; the source is then to be given its own with `restore`.

        Raises:
            SourceError: If it cannot be opened, with the remedy.
        """
        opening = self._opening(report)
        return kind_of(self.config.source.type).open(replace(opening, stored=stored))

    def check_files(self) -> None:
        """Open the files of the source, and close them, and look up its password; raises as `open`."""
        if (variable := getattr(self.config.source, "password_env", None)) is not None:
            secret(variable, (*KEY, "password_env"), self.source.loaded.places)
        kind_of(self.config.source.type).files(self._opening(lambda *_: None))

    def _opening(self, report: Report) -> Opening:
        given = self.config.assets
        assets = given if isinstance(given, tuple) else ()
        section = self.config.source
        return Opening(self.source.loaded, self.twin.model, section, KEY, report, of_assets=True, assets=assets)

    def history_of(self, asset: str, folder: Path) -> dict[str, str]:
        """Return the overrides of the twin's YAML by which its source has the measurements of one asset.

        `folder` is for copies of the tables with the rows of that asset.

        Raises:
            ConfigError: If the source keeps none.
        """
        section = self.config.source
        if not isinstance(section, FleetTableSection):
            text = f"a source of type {section.type} keeps no measurements; give --archive FOLDER to keep them"
            raise ConfigError(f"{asset}: {text}")
        given = section.model_dump(mode="json", exclude_unset=True)
        loaded, column = self.source.loaded, given.pop("asset")
        found = channels(loaded, section, KEY, self.twin.model)
        columns = [*section.time.column, column, *(column_of(name) for _, item in found for name in item.needed)]
        files = [path for pattern in section.files for path in matching(loaded, section, pattern)]
        files = rows_of_asset(list(dict.fromkeys(files)), column, asset, list(dict.fromkeys(columns)), folder)
        given |= {"files": [str(path.absolute()) for path in files], "follow": False}
        given.pop("folder", None)
        for group in ("sensors", "inputs", "truth"):
            for channel in given.get(group, {}).values():
                channel["only"] = {**channel.get("only", {}), column: {"text": [asset]}}
        return self._overrides(asset, given)

    def archived(self, asset: str, folder: Path, span: float = 0.0) -> dict[str, str]:
        """Return the overrides of the twin's YAML by which it follows the archived rows of one asset in a folder.

        Charts begin with the `span` of these rows, s, rounded up, or the last day.
        """
        model = self.twin.model

        def only(event: str, channel: int, columns: Iterable[str]) -> JsonObject:
            return {"columns": [*columns], "only": {"event": {"text": [event]}, "channel": channel}}

        given: JsonObject = {"type": "table", "files": [str(folder.absolute() / "*.parquet")], "follow": True}
        given["time"] = {"column": "t_ns", "unit": "ns"}
        sensors = {
            sensor.name: only("reading", k, (f"value_{row}" for row in range(len(sensor.rows))))
            for k, sensor in enumerate(model.sensors)
        }
        inputs = {name: only("input", 0, [f"value_{k}"]) for k, name in enumerate(model.input_names)}
        window = next((width for width in WINDOWS_S if width >= span), WINDOWS_S[-1])
        return {"view.window": str(window)} | self._overrides(asset, given | {"sensors": sensors, "inputs": inputs})

    def _overrides(self, asset: str, source: Mapping[str, object]) -> dict[str, str]:
        """Return the overrides of the twin's YAML for one asset with its own tuning and a source."""
        name = re.sub(r"[^A-Za-z0-9_-]", "_", asset).lstrip("_-") or "asset"
        own = {key: repr(value) for key, value in self.values.of(asset).items()}
        # The outputs are those of the fleet.
        return {
            "outputs": "{}",
            "alerts": "[]",
            "source": as_flow(source),
            "name": as_flow(name),
            "title": as_flow(asset),
            **own,
        }


def load_fleet(path: str | os.PathLike[str], overrides: Mapping[str, str] | None = None) -> FleetPlan:
    """Read and check a fleet's YAML, and put its twin together.

    Args:
        path: The YAML file.
        overrides: The command line's `--set KEY=VALUE` for the twin.

    Raises:
        ConfigError: If the YAML, the twin or an override breaks a rule.
        ModelError: If the model's file fails.
    """
    path = Path(path).expanduser()
    text = read_text(path, "nisus fleet --help")
    section, _, places = check_section(FleetSection, text, path, "a fleet is a mapping with twin and source")
    tell_older(places)
    named = section.twin
    if named not in shipped():
        named = str(path.parent / Path(named).expanduser())
        if not Path(named).is_file():
            rule = "there is no such file or bundled twin; check the path, or see `nisus twins`"
            raise ConfigError(f"{places.at(('twin',))}: twin is {section.twin!r}; {rule}")
    twin = load_twin(named, overrides=overrides)
    config = twin.config.model_copy(update={"source": section.source, "faults": ()})
    loaded = replace(twin.loaded, config=config, path=path, text=text, places=places, version=None, without=None)
    plan = plan_source(loaded, twin.model, None)
    if plan.brings_variances:
        raise loaded.error(KEY, "has sensors with accuracy; a fleet uses the tuned R: leave accuracy out")
    if section.late == 0 and twin.tuning.gate is not None and twin.tuning.reopen is not None:
        rule = "decisions on a rejected sensor need snapshots: give 1 or more, or set gate.reopen to null"
        raise ConfigError(f"{places.at(('late',))}: late is 0, and the gate of {twin.name} reopens; {rule}")
    check_receivers(loaded, section.outputs, section.alerts)
    assets = section.assets if isinstance(section.assets, tuple) else None
    values = asset_values(section.tunings, path, places, twin.tuning, assets)
    if isinstance(section.assets, int) and len(values.names) > section.assets:
        rule = f"there may be {section.assets}; enlarge assets"
        raise ConfigError(f"{places.at(('tunings',))}: tunings names {len(values.names)} assets; {rule}")
    return FleetPlan(path, section, twin, plan, values)
