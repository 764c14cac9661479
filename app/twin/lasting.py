"""Errors that last, as a twin's YAML gives them: `over` of a noise, and `error` of a sensor."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from config.loader import Loaded
from config.yaml_lines import Key, dotted
from estimators.errors import ConfigError, ModelError
from estimators.model.coloured import Lasting, coloured
from estimators.model.state_space import StateSpaceModel

from .names import check_names, one_each


def with_lasting_errors(model: StateSpaceModel, loaded: Loaded) -> StateSpaceModel:
    """The model with the states that carry what the YAML says lasts.

    Raises:
        ConfigError: With file and line, if it names what the model lacks, or something that cannot last.
    """
    config = loaded.config
    noises = {name: section for name, section in config.noise.items() if section.over is not None}
    errors = {name: section.error for name, section in config.sensors.items() if section.error is not None}
    check_names(loaded, ("noise",), noises, [item.name for item in model.noises], "noise", model)
    check_names(loaded, ("sensors",), errors, model.sensor_names, "sensor", model)
    # How strong it is says how far it is spread at the start.
    given = {name: section.value for name, section in noises.items()}
    model = replace(
        model, noises=tuple(replace(item, variance=given.get(item.name, item.variance)) for item in model.noises)
    )
    times = {name: section.over or 0.0 for name, section in noises.items()}
    for name, over in times.items():
        with _placed(loaded, ("noise", name, "over")):
            coloured(model, {name: over})
    lasting = {}
    for name, error in errors.items():
        rows = [row.name for row in model.sensors[model.sensor_names.index(name)].rows]
        key = ("sensors", name, "error")
        variances = one_each(loaded, (*key, "std" if error.std is not None else "variance"), error.variances, rows)
        lasting[name] = Lasting(variances, error.over)
        with _placed(loaded, key):
            coloured(model, errors={name: lasting[name]})
    return coloured(model, times, lasting)


@contextmanager
def _placed(loaded: Loaded, key: Key) -> Iterator[None]:
    """What cannot last is said of its place in the YAML."""
    try:
        yield
    except ModelError as error:
        raise ConfigError(f"{loaded.places.at(key)}: {dotted(key)}: {error}") from None
