"""Sources of type push: messages that other programs send."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from config.source_schema import ColumnSection, PushSection
from config.yaml_files import Key
from estimators.model.state_space import StateSpaceModel
from sources.pieces import VALUES

from .kind import Kind, Opening, blamed, failure

if TYPE_CHECKING:
    from sources.source import Source


def _open(opening: Opening) -> Source:
    from sources.messages import Messages

    if not opening.live:
        text = (
            "has no recording; record a session (`nisus run TWIN --record FILE.rrd`) and give its file to the command"
        )
        raise failure(opening.loaded, opening.key, text)
    named = replace(opening, section=with_channels(opening.section, opening.model))
    return blamed(named, lambda channels: Messages(channels, width=opening.model.width, report=opening.report))


def with_channels(section: PushSection, model: StateSpaceModel) -> PushSection:
    """Return a section with its channels; of one without any, all sensors and inputs by their own names."""
    if _sections(section, ()):
        return section
    rows, starts = model.row_names, model.row_start
    sensors = {
        sensor.name: ColumnSection(columns=tuple(rows[start : start + len(sensor.rows)]))
        for sensor, start in zip(model.sensors, starts, strict=True)
    }
    inputs = {item.name: ColumnSection(columns=(item.name,)) for item in model.inputs}
    return section.model_copy(update={"sensors": sensors, "inputs": inputs})


def _sections(section: PushSection, key: Key) -> dict[Key, Any]:
    return {key: section} if section.sensors or section.inputs or section.truth else {}


PUSH = Kind(_open, sections=_sections, takes_log=False, kernels=(VALUES,))
