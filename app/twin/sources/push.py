"""Sources of messages: those that other programs send, and those of a broker, a server or a device."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from config.channels import ColumnSection, MessagesSection
from config.yaml_files import Key
from estimators.errors import nearest
from estimators.model.state_space import StateSpaceModel
from sources.pieces import VALUES

from .kind import Kind, Opening, blamed, failure

if TYPE_CHECKING:
    from config.fields import Section
    from sources.messages import Messages
    from sources.source import Source


def messages_of(opening: Opening, key: str = "", named: Iterable[str] = ()) -> Messages:
    """Return the values of a source; refuse those `named` under `key` that feed nothing."""
    from sources.messages import Messages

    if not opening.live:
        text = (
            "has no recording; record a session (`nisus run TWIN --record FILE.rrd`) and give its file to the command"
        )
        raise failure(opening.loaded, opening.key, text)
    section = replace(opening, section=with_channels(opening.section, opening.model))
    width, report = opening.model.width, opening.report
    assets = opening.of_assets
    messages = blamed(section, lambda channels: Messages(channels, width=width, report=report, assets=assets))
    for name in sorted(set(named) - set(messages.names)):
        text = f"names {name!r}, no value of this twin; {nearest(name, messages.names)}"
        raise failure(opening.loaded, (*opening.key, key), text)
    return messages


def with_channels(section: MessagesSection, model: StateSpaceModel) -> MessagesSection:
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


def _sections(section: MessagesSection, key: Key) -> dict[Key, Section]:
    return {key: section} if section.sensors or section.inputs or section.truth else {}


def of_messages(open_: Callable[[Opening], Source]) -> Kind:
    """Return the kind of a live source of messages, which has no recording."""
    return Kind(open_, sections=_sections, takes_log=False, kernels=(VALUES,))


PUSH = of_messages(messages_of)
