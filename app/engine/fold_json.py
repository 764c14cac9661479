"""Settings, tuning versions and bases of folds as JSON text, which keeps float64 exactly."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np

from config.tunings import Version, version_of
from estimators.gate.rejection_runs import REMEMBERED
from estimators.model.state_space import StateSpaceModel
from estimators.snapshots import Base
from estimators.tuning import Tuning

ENSEMBLES = ("enkf", "etkf", "ensrf", "letkf")


def tuning_to_json(tuning: Tuning, estimator: str) -> str:
    """Return a tuning and its estimator as text, which keeps float64 exactly."""
    arrays = {name: getattr(tuning, name).tolist() for name in ("q", "r", "p", "used")}
    plain = {name: getattr(tuning, name) for name in ("gate", "gate_kind", "reopen", "seed", "name")}
    members = {"members": 200} if estimator in ENSEMBLES else {}
    return json.dumps({"estimator": estimator, **arrays, **plain, "options": dict(tuning.options), **members})


def tuning_from_json(text: str, model: StateSpaceModel, baseline: np.ndarray | None = None) -> tuple[Tuning, str]:
    """Return the tuning, with the baseline of the twin's file, and the estimator that `tuning_to_json` wrote."""
    values = json.loads(text)
    # In older recordings and stores an ensemble had 50 members by default.
    former = {"members": 50.0} if "members" not in values and values["estimator"] in ENSEMBLES else {}
    tuning = Tuning(
        model=model,
        q=np.array(values["q"], float),
        r=np.array(values["r"], float),
        p=np.array(values["p"], float),
        used=np.array(values["used"], bool),
        gate=values["gate"],
        # In older recordings the gate was hard and never reopened.
        gate_kind=values.get("gate_kind", "hard"),
        reopen=values.get("reopen"),
        options=former | values["options"],
        seed=values["seed"],
        name=values.get("name", ""),
        baseline=baseline,
    )
    return tuning, values["estimator"]


def version_to_json(version: Version) -> str:
    """Return a tuning version as text, with the content of its file."""
    return json.dumps({"name": version.name, "path": str(version.path), "text": version.text})


def version_from_json(text: str) -> Version:
    """Return the version that `version_to_json` wrote."""
    values = json.loads(text)
    return version_of(values["name"], values["text"], Path(values["path"]))


def base_to_json(base: Base | None) -> str:
    """Return a base as text, which keeps float64 exactly."""
    if base is None:
        return "null"
    moments = {"mean": base.mean.tolist(), "cov": base.cov.tolist(), "clock": base.clock, "u": base.u.tolist()}
    moments |= {"first": base.first, "version": base.version}
    arrays = {"state": base.state, "edge": base.edge, "evidence": base.evidence, "doubt": base.doubt}
    known = {key: np.ascontiguousarray(array, "<f8") for key, array in arrays.items() if array is not None}
    held = {key: base64.b64encode(array.tobytes()).decode() for key, array in known.items()}
    return json.dumps({**moments, "estimator": base.estimator, **held})


def _from_base64(text: str | None) -> np.ndarray | None:
    return None if text is None else np.frombuffer(base64.b64decode(text), "<f8").astype(float)


def base_from_json(text: str) -> Base | None:
    """Return the base that `base_to_json` wrote; in older recordings it has moments only."""
    values = json.loads(text)
    if values is None:
        return None
    doubt = _from_base64(values.get("doubt"))
    return Base(
        np.array(values["mean"]),
        np.array(values["cov"]),
        int(values["clock"]),
        np.array(values["u"], float),
        values.get("estimator", ""),
        _from_base64(values.get("state")),
        int(values.get("first", 0)),
        evidence=_from_base64(values.get("evidence")),
        edge=_from_base64(values.get("edge")),
        version=int(values.get("version", 1)),
        doubt=None if doubt is None else doubt.reshape(-1, REMEMBERED),
    )
