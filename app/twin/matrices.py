"""Linear models from the matrices of a .mat or .npz file, named by the twin's YAML."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from config.loader import Loaded
from config.model_schema import MatricesSection
from config.yaml_files import shown_path
from estimators.errors import ConfigError, ModelError, nearest
from estimators.model.linear import linear_model
from estimators.model.state_space import Input, Row, State, StateSpaceModel
from sources.worker_process import gist

from .checks import check_stated


def matrices_model(loaded: Loaded, section: MatricesSection, path: Path) -> StateSpaceModel:
    """Return the linear model of a file of matrices, with the prior and the noise of the YAML.

    Raises:
        ConfigError: With file and line, if the file lacks a matrix, or the YAML a prior or a noise.
        ModelError: If a matrix does not fit the names, or a discrete model has no continuous form.
    """
    arrays = _read(path, loaded)
    sensors = [
        (name, [Row(row, unit, 1.0) for row, unit in rows.items()])
        for name, rows in ((k, {k: v} if isinstance(v, str) else v) for k, v in section.sensors.items())
    ]
    nx, nu, ny = len(section.states), len(section.inputs), sum(len(rows) for _, rows in sensors)
    keys = section.keys
    A, C = (_matrix(arrays, letter, getattr(keys, letter), path, loaded) for letter in "AC")
    B = _matrix(arrays, "B", keys.B, path, loaded) if nu or keys.B in arrays else np.zeros((nx, 0))
    D = _matrix(arrays, "D", keys.D, path, loaded) if keys.D in arrays else np.zeros((ny, nu))
    sample_time = section.sample_time
    if sample_time is None:
        sample_time = float(_matrix(arrays, "dt", keys.dt, path, loaded).ravel()[0]) if keys.dt in arrays else 0.0
    try:
        model = linear_model(
            path.stem,
            A,
            B,
            C,
            D,
            states=[State(name, unit) for name, unit in section.states.items()],
            inputs=[Input(name, unit) for name, unit in section.inputs.items()],
            sensors=sensors,
            sample_time=sample_time,
            title=f"Linear model of {path.name}",
        )
    except ModelError as error:
        raise ModelError(f"{shown_path(path)}: {error}") from None
    check_stated(loaded, model, "a file of matrices")
    return model


def _read(path: Path, loaded: Loaded) -> Mapping[str, object]:
    """Return the arrays of a file by name."""
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        if path.suffix == ".mat":
            from scipy.io import loadmat

            return {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    except NotImplementedError:
        rule = "MATLAB wrote it as v7.3; write it with save(..., '-v7')"
        raise ConfigError(f"{shown_path(path)}: {rule}") from None
    except Exception as error:  # noqa: BLE001  readers of damaged files raise anything
        raise ConfigError(f"{shown_path(path)}: it cannot be read ({gist(error)}); write it again") from None
    raise loaded.error(("model", "matrices"), f"is {path.name!r}; it must be a .mat or a .npz file")


def _matrix(arrays: Mapping[str, object], letter: str, key: str, path: Path, loaded: Loaded) -> np.ndarray:
    """Return a matrix of the file as real numbers of two dimensions."""
    if key not in arrays:
        rule = nearest(key, arrays) if arrays else "it has no arrays"
        raise loaded.error(
            ("model", "keys", letter), f"is {key!r}; {shown_path(path)} has no array of that name; {rule}"
        )
    try:
        value = np.asarray(getattr(arrays[key], "toarray", lambda: arrays[key])())
        if value.dtype.kind not in "biuf" or value.ndim > 2 or value.size == 0:
            raise TypeError
    except (TypeError, ValueError):
        raise loaded.error(
            ("model", "keys", letter), f"is {key!r}, in {shown_path(path)} no matrix of real numbers; name one"
        ) from None
    # One row or one column, where a vector was saved.
    return np.asarray(value, float).reshape(value.shape if value.ndim == 2 else (-1, 1) if letter in "AB" else (1, -1))
