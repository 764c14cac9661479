"""The schema of a fleet's YAML: a twin, its assets, and the source of their measurements."""

from __future__ import annotations

from pydantic import model_validator

from .fields import Count, Section, Text, Texts, refused
from .source_schema import TableSection


class FleetTableSection(TableSection):
    """Tables (CSV or Parquet) with the measurements of many assets."""

    asset: Text
    """Column with the name of each row's asset."""


class FleetSection(Section):
    """Many assets of one twin."""

    twin: Text
    """Name of a bundled twin, or path to a YAML file, relative to this file. Model, tuning and estimator are its own;
    its source, outputs and faults are not used."""
    assets: Texts | Count | None = None
    """Names of the assets, from which others are refused; or how many there may be, named by the source in the order of
    their first measurements. Default: as many as the source names."""
    source: FleetTableSection
    """Tables with the measurements of the assets."""

    @model_validator(mode="after")
    def _once(self) -> FleetSection:
        if isinstance(self.assets, tuple) and len(set(self.assets)) < len(self.assets):
            twice = next(name for name in self.assets if self.assets.count(name) > 1)
            raise refused("relation", f"names {twice!r} twice; name each asset once", "assets")
        return self
