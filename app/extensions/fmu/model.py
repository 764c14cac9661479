"""Models in FMUs (FMI 2 and 3, model exchange) as black boxes. Extra `fmu`: `pip install 'nisus[fmu]'`.

An FMU is native code, which runs with the rights of the user.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np

from app.twin.checks import check_stated
from config.loader import Loaded
from config.yaml_files import Key, shown_path
from estimators.errors import ModelError, nearest
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel, squared
from sources.worker_process import gist

from .instance import Fmu
from .schema import FmuSection, variable_name

if TYPE_CHECKING:
    from fmpy.model_description import ModelDescription, ScalarVariable

EXCHANGE = "export it for model exchange"


def fmu_model(loaded: Loaded, section: FmuSection, path: Path) -> StateSpaceModel:
    """Return the black box of an FMU, with the prior and the noise of the YAML.

    Raises:
        ConfigError: With file and line, if FMPy is missing, the YAML names what the FMU lacks or lacks a noise.
        ModelError: If the FMU lacks a capability that filters need; the line names it.
    """
    key = (path, sha256(path.read_bytes()).hexdigest(), section.model_dump_json())
    model = _models.get(key)
    if model is None:
        model = _models[key] = _model(path, section, loaded)
    check_stated(loaded, model, "an FMU")
    return model


_models: WeakValueDictionary[tuple[Path, str, str], StateSpaceModel] = WeakValueDictionary()
"""Models in use by content of the file and section, so that one is loaded and checked once."""


def _model(path: Path, section: FmuSection, places: Loaded) -> StateSpaceModel:
    """Return the model of an FMU."""
    try:
        import fmpy
    except ImportError:
        raise places.error(("model", "fmu"), "needs FMPy: pip install 'nisus[fmu]'") from None
    try:
        description = fmpy.read_model_description(str(path))
    except Exception as error:  # noqa: BLE001  of XML, zip files and FMPy
        raise ModelError(f"{shown_path(path)}: it is no readable FMU ({gist(error)}); export it again") from None
    _check_kind(description, path)
    states = [unknown.variable.derivative for unknown in description.derivatives]
    found = _Variables(description, section, places)
    names = {variable_name(item.name): item for item in states}
    for name, variable in section.states.items():
        if variable not in (item.name for item in states):
            rule = nearest(variable, [item.name for item in states])
            raise places.error(("model", "states", name), f"is {variable!r}, no continuous state of the FMU; {rule}")
        names = {name if item.name == variable else key: item for key, item in names.items()}
    if len(names) < len(states):
        raise places.error(("model", "states"), "gives two states one name; every name must differ")
    inputs = found.named("input") if section.inputs is None else section.inputs
    given = section.sensors
    if given is None:
        given = found.named("output")
        if not given:
            raise places.error(("model",), "names no sensors, and the FMU has no real output; give sensors")
    sensors = {name: {name: rows} if isinstance(rows, str) else rows for name, rows in given.items()}
    u = [found.of(("model", "inputs", name), variable) for name, variable in inputs.items()]
    p = [found.of(("model", "parameters", name), variable) for name, variable in section.parameters.items()]
    y = {
        name: [found.of(("model", "sensors", name), variable) for variable in rows.values()]
        for name, rows in sensors.items()
    }
    for key in section.units:
        found.of(("model", "units"), key)
    fmu = Fmu(path, description, len(states), [item.valueReference for item in u], [item.valueReference for item in p])
    start = fmu.start()
    return StateSpaceModel(
        name=path.stem,
        title=description.description or description.modelName or path.stem,
        states=tuple(
            State(name, found.unit(item), float(value))
            for (name, item), value in zip(names.items(), start, strict=True)
        ),
        inputs=tuple(
            Input(name, found.unit(item), value) for name, item, value in zip(inputs, u, fmu.default_u, strict=True)
        ),
        parameters=tuple(
            Parameter(name, found.unit(item), value, float(item.min or -np.inf), float(item.max or np.inf))
            for name, item, value in zip(section.parameters, p, fmu.default_p, strict=True)
        ),
        noises=tuple(Noise(name, f"{squared(found.unit(item))}/s", 0.0) for name, item in names.items()),
        sensors=tuple(
            Sensor(
                name,
                tuple(Row(row, found.unit(item), 1.0) for row, item in zip(sensors[name], items, strict=True)),
                h=fmu.measured([item.valueReference for item in items]),
            )
            for name, items in y.items()
        ),
        f=fmu.advance,
        black_box=True,
        max_step=section.step,
        source=description.generationTool or "",
    )


def _check_kind(description: ModelDescription, path: Path) -> None:
    """Refuse an FMU that offers no model exchange, of another FMI, or without continuous states."""
    name, kind = shown_path(path), description.modelExchange
    if not description.fmiVersion.startswith(("2.", "3.")):
        raise ModelError(f"{name}: it is of FMI {description.fmiVersion}; export it as FMI 2.0 or 3.0")
    if kind is None:
        own = description.coSimulation
        why = "without canGetAndSetFMUstate" if own is None or not own.canGetAndSetFMUstate else (
            "whose canGetAndSetFMUstate restores a state but cannot set the one that a filter asks for"
        )  # fmt: skip
        raise ModelError(f"{name}: it offers co-simulation only, {why}; {EXCHANGE}")
    if kind.needsExecutionTool:
        raise ModelError(f"{name}: it needs the tool that wrote it (needsExecutionTool); export it self-contained")
    if not description.derivatives:
        raise ModelError(
            f"{name}: it has no continuous states, so a filter has nothing to estimate; {EXCHANGE} with some"
        )
    for unknown in description.derivatives:
        if unknown.variable.derivative is None or unknown.variable.derivative.dimensions:
            raise ModelError(f"{name}: its state derivative {unknown.variable.name} is an array; export scalar states")


class _Variables:
    """The real variables of an FMU, and their units."""

    def __init__(self, description: ModelDescription, section: FmuSection, places: Loaded) -> None:
        self.reals = {
            item.name: item
            for item in description.modelVariables
            if item.type in ("Real", "Float64") and not item.dimensions
        }
        self._units, self._places = section.units, places

    def of(self, key: Key, name: str) -> ScalarVariable:
        """Return the variable of a name given at `key`."""
        if name not in self.reals:
            rule = nearest(name, self.reals) if self.reals else "it has none"
            raise self._places.error(key, f"names {name!r}, no real variable of the FMU; {rule}")
        return self.reals[name]

    def named(self, causality: str) -> dict[str, Any]:
        """Return the variables that are inputs, or outputs, by their names in a model."""
        return {variable_name(item.name): item.name for item in self.reals.values() if item.causality == causality}

    def unit(self, item: ScalarVariable) -> str:
        """Return the unit of a variable."""
        declared = item.declaredType.unit if item.declaredType is not None else None
        return self._units.get(item.name) or item.unit or declared or "1"
