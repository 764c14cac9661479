"""The learned correction of a twin, read from its file."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from config.loader import Loaded
from config.yaml_files import shown_path
from estimators.errors import ConfigError
from estimators.model.correction import Correction, GaussianProcess, Net, Ridge
from estimators.model.hybrid import LearnedCorrection
from estimators.model.state_space import StateSpaceModel
from sources.worker_process import gist

from .schema import CorrectionSection, load_correction

INSTALL = "pip install 'nisus[learned]'"


def correction_of(loaded: Loaded, model: StateSpaceModel, path: Path) -> tuple[LearnedCorrection, str]:
    """Return the correction that the YAML names, and its file as errors name it.

    Raises:
        ConfigError: If its file is missing, is wrong, or is of another model.
    """
    if not path.is_file():
        raise loaded.error(("correction",), f"is {loaded.config.correction!r}; there is no file {shown_path(path)}; "
                           "`nisus learn` writes one")  # fmt: skip
    section, places = load_correction(path)
    if section.learned.model != model.name:
        raise ConfigError(
            f"{places.at(('learned', 'model'))}: learned.model is {section.learned.model!r}; that of "
            f"{loaded.path.stem} is {model.name!r}, whose states and inputs are others; learn it anew"
        )
    return learned_of(section, path), places.at(())


def learned_of(section: CorrectionSection, path: Path) -> LearnedCorrection:
    """Return the correction of a file at `path`; the same object for the same content, so that it is compiled once.

    Raises:
        ConfigError: If its net cannot be read.
    """
    net = None if section.net is None else path.parent / section.net
    stamp = net.stat().st_mtime_ns if net is not None and net.is_file() else 0
    return _learned_of(section.model_dump_json(), net, stamp)


@lru_cache(maxsize=16)
def _learned_of(text: str, net: Path | None, stamp: int) -> LearnedCorrection:
    section = CorrectionSection.model_validate_json(text)
    points = np.array(section.points, float)
    rates = np.array(section.rates or (), float)
    correction: Correction
    if section.kind == "gp":
        correction = GaussianProcess(points, rates, np.array(section.lengths, float), float(section.ratio or 0.0))
    elif section.kind == "ridge":
        correction = Ridge(points, rates, float(section.penalty or 0.0), section.degree)
    else:
        assert net is not None
        correction = Net(points, run_net(net, len(section.features), len(section.corrects)))
    noise = tuple(section.noise[name] for name in section.corrects)
    return LearnedCorrection(section.corrects, section.features, noise, correction)


def run_net(path: Path, features: int, corrects: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return an ONNX network as a function of features (N, d) to rates (N, k), run state by state.

    Blocks of other sizes would be rounded differently.

    Raises:
        ConfigError: If onnxruntime is not installed, or the file holds no network of these sizes.
    """
    try:
        import onnxruntime
    except ImportError:
        raise ConfigError(f"{shown_path(path)}: a net needs onnxruntime, which is not installed: {INSTALL}") from None
    if not path.is_file():
        raise ConfigError(f"{shown_path(path)}: there is no such file; name an ONNX file beside the correction's")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001  its errors have no common base but this
        raise ConfigError(f"{shown_path(path)}: it cannot be read as an ONNX network: {gist(error)}") from None
    given, told = session.get_inputs(), session.get_outputs()
    kinds = {"tensor(float)": np.float32, "tensor(double)": np.float64}
    if len(given) != 1 or given[0].type not in kinds:
        raise ConfigError(
            f"{shown_path(path)}: it takes {', '.join(f'{item.name} {item.type}' for item in given)}; a net takes one "
            "tensor of float or double, (N, features)"
        )
    name, kind = given[0].name, kinds[given[0].type]

    def run(z: np.ndarray) -> np.ndarray:
        rows = [session.run([told[0].name], {name: row[None].astype(kind)})[0] for row in np.asarray(z)]
        return np.array(rows, float).reshape(len(rows), -1)

    try:
        found = run(np.zeros((1, features)))
    except Exception as error:  # noqa: BLE001  as above
        raise ConfigError(f"{shown_path(path)}: it does not take {features} features: {gist(error)}") from None
    if found.shape != (1, corrects):
        raise ConfigError(
            f"{shown_path(path)}: it gives {found.shape[1]} numbers; it must give one for each of {corrects} corrected "
            "states"
        )
    return run
