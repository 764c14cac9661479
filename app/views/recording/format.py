"""The recording: an .rrd file that Rerun opens, and that holds all it takes to fold again, to the bit.

Beside what charts show, the file keeps under /nisus, as plain columns: `twin` (YAML, tuning version, what the command
line changed, base), `tuning` (each one, with the event from which it was in force), `events` (the log), `base` (where a
fold of them starts, if that has moved), `notices` (lines for people) and `summary` (what the session was worth, for
lists). The track is not among them: log and tuning give it again. Rows carry their absolute index; a late reading makes
a recorder write the events again from where it belongs. `reader` reads them back.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from config.tunings import Version, version_of
from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.score import Score, score
from estimators.errors import NisusError, SourceError
from estimators.gate.rejection_runs import REMEMBERED
from estimators.log import Events
from estimators.model.state_space import StateSpaceModel
from estimators.snapshots import Base
from estimators.track import Track
from estimators.tuning import Tuning

from ...live.history_copy import copy_rows
from ...live.interface import Running
from ...live.outputs import Pull
from .rrd_file import RrdFile

FORMAT = 2
READABLE = (1, 2)
"""Formats that can be read; the first kept the track too."""
PREFIX = "nisus_"
"""Of the name under which a recording is known to Rerun; the twin's follows."""
TIMELINE = "event"


def tuning_to_json(tuning: Tuning, estimator: str) -> str:
    """A tuning and its estimator as text; float64s survive exactly."""
    return json.dumps(
        {
            "estimator": estimator,
            "q": tuning.q.tolist(),
            "r": tuning.r.tolist(),
            "p": tuning.p.tolist(),
            "used": tuning.used.tolist(),
            "gate": tuning.gate,
            "gate_kind": tuning.gate_kind,
            "reopen": tuning.reopen,
            "options": dict(tuning.options),
            "seed": tuning.seed,
            "name": tuning.name,
        }
    )


def tuning_from_json(text: str, model: StateSpaceModel) -> tuple[Tuning, str]:
    """The tuning and the estimator that `tuning_to_json` wrote."""
    values = json.loads(text)
    tuning = Tuning(
        model=model,
        q=np.array(values["q"], float),
        r=np.array(values["r"], float),
        p=np.array(values["p"], float),
        used=np.array(values["used"], bool),
        gate=values["gate"],
        # Of older recordings the gate was hard, and never opened again.
        gate_kind=values.get("gate_kind", "hard"),
        reopen=values.get("reopen"),
        options=values["options"],
        seed=values["seed"],
        name=values.get("name", ""),
    )
    return tuning, values["estimator"]


def version_to_json(version: Version) -> str:
    """A tuning version as text: its file, whole."""
    return json.dumps({"name": version.name, "path": str(version.path), "text": version.text})


def version_from_json(text: str) -> Version:
    """The version that `version_to_json` wrote."""
    values = json.loads(text)
    return version_of(values["name"], values["text"], Path(values["path"]))


def base_to_json(base: Base | None) -> str:
    """A base as text; float64s survive exactly."""
    if base is None:
        return "null"
    moments = {"mean": base.mean.tolist(), "cov": base.cov.tolist(), "clock": base.clock, "u": base.u.tolist()}
    moments |= {"first": base.first, "version": base.version}
    arrays = {"state": base.state, "edge": base.edge, "evidence": base.evidence, "doubt": base.doubt}
    held = {key: _packed(array) for key, array in arrays.items() if array is not None}
    return json.dumps({**moments, "estimator": base.estimator, **held})


def _packed(numbers: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(numbers, "<f8").tobytes()).decode()


def _unpacked(text: str | None) -> np.ndarray | None:
    return None if text is None else np.frombuffer(base64.b64decode(text), "<f8").astype(float)


def base_from_json(text: str) -> Base | None:
    """The base that `base_to_json` wrote; older recordings hold moments only, and no index or evidence."""
    values = json.loads(text)
    if values is None:
        return None
    doubt = _unpacked(values.get("doubt"))
    return Base(
        np.array(values["mean"]),
        np.array(values["cov"]),
        int(values["clock"]),
        np.array(values["u"], float),
        values.get("estimator", ""),
        _unpacked(values.get("state")),
        int(values.get("first", 0)),
        evidence=_unpacked(values.get("evidence")),
        edge=_unpacked(values.get("edge")),
        version=int(values.get("version", 1)),
        doubt=None if doubt is None else doubt.reshape(-1, REMEMBERED),
    )


TAKEN = "is there already; choose another name, or remove it"
"""What is said of a name that something stands under."""


class RecordingFile:
    """An .rrd that is being written, in a stream of its own: no viewer can hold it up."""

    def __init__(
        self,
        path: Path,
        *,
        name: str,
        text: str,
        twin_path: Path,
        base: Base | None,
        overrides: Mapping[str, str] | None = None,
        version: Version | None = None,
    ) -> None:
        """Begin a file.

        Args:
            path: Where; nothing may stand there yet, not even a link that leads nowhere.
            name: Of the twin.
            text: The twin's YAML.
            twin_path: Where the YAML was, for the model's file beside it.
            base: Where the fold of the first event starts, if older events were dropped before.
            overrides: What the command line changed of the YAML, by key.
            version: The tuning version whose values stand in place of the YAML's.

        Raises:
            SourceError: If the file cannot be written.
        """
        self.path = path
        self.stream = rr.RecordingStream(f"{PREFIX}{name}", recording_id=f"{name}-{path.stem}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = RrdFile(path, self.stream)
        except FileExistsError:
            raise SourceError(f"recording {path}: {TAKEN}") from None
        except OSError as error:
            raise SourceError(f"recording {path}: {error.strerror}; choose a place that can be written") from None
        self.rows = 0
        self._header = {"name": name, "path": str(twin_path), "base": base_to_json(base)}
        self.twin(text, overrides or {}, version)

    @property
    def size(self) -> int:
        """Bytes that the file has taken."""
        return self._file.size

    def twin(self, text: str, overrides: Mapping[str, str], version: Version | None) -> None:
        """Write the twin's YAML and its tuning version, again when one was saved anew: the last ones count."""
        more = {"yaml": text, "overrides": json.dumps(dict(overrides))}
        if version is not None:
            more["version"] = version_to_json(version)
        self.stream.log("/nisus/twin", rr.AnyValues(format=FORMAT, **self._header, **more), static=True)

    def base(self, base: Base | None, index: int, revision: int) -> None:
        """Write where a fold of a revision starts, from event `index` on; None is the prior."""
        self.stream.send_columns(
            "/nisus/base",
            indexes=[rr.TimeColumn(TIMELINE, sequence=[index])],
            columns=rr.AnyValues.columns(json=[base_to_json(base)], revision=[revision]),
        )

    def tuning(self, tuning: Tuning, estimator: str, index: int, revision: int) -> None:
        """Write the tuning that is in force from event `index` on."""
        self.stream.send_columns(
            "/nisus/tuning",
            indexes=[rr.TimeColumn(TIMELINE, sequence=[index])],
            columns=rr.AnyValues.columns(json=[tuning_to_json(tuning, estimator)], revision=[revision]),
        )

    def summary(self, found: Mapping[str, Any]) -> None:
        """Write what the session was worth when the file was closed, for lists."""
        self.stream.log("/nisus/summary", rr.AnyValues(json=json.dumps(dict(found))), static=True)

    def write(self, pull: Pull) -> None:
        """Write rows of the log, and the lines for people."""
        if pull.notices:
            self.stream.send_columns(
                "/nisus/notices",
                indexes=[rr.TimeColumn("notice", sequence=[line.number for line in pull.notices])],
                columns=rr.AnyValues.columns(
                    t=np.array([line.t for line in pull.notices], np.int64),
                    level=[line.level for line in pull.notices],
                    text=[line.text for line in pull.notices],
                ),
            )
        count = len(pull.events)
        if not count:
            return
        index = [rr.TimeColumn(TIMELINE, sequence=np.arange(pull.first, pull.first + count))]
        # As Arrow's arrays: Rerun would turn NumPy's into Python lists, which takes fifty times as long.
        flat: dict[str, pa.Array] = {}
        for name, column in zip(pull.events._fields, pull.events, strict=True):
            if column.ndim == 1:
                flat[name] = pa.array(column)
            else:
                flat |= {f"{name}_{k}": pa.array(column[:, k]) for k in range(column.shape[1])}
        self.stream.send_columns("/nisus/events", indexes=index, columns=rr.AnyValues.columns(**flat))
        self.rows += count

    def flush(self) -> None:
        """Hand everything to the operating system.

        Raises:
            OSError: If the file takes no more; what it took before stays, and can be read.
        """
        self._file.flush()

    def abandon(self) -> None:
        """Leave a file that takes no more as it is."""
        self._file.abandon()

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: As `flush`.
        """
        self._file.close()


def summary_of(engine: Running) -> dict[str, Any]:
    """Estimator, mean NIS and how it is judged, and the first error that could be taken, of what runs; or less.

    `error` is {name, rmse, unit, coverage, against}: of the first state with a truth, else of a sensor held out.
    """
    try:
        pull = copy_rows(engine)
        tuning, estimator = engine.folded_with()
        if pull is None:
            return {"estimator": estimator}
        return summary(estimator, tuning, pull.events, pull.track, pull.pictures)
    except NisusError:
        return {}


def summary(
    estimator: str, tuning: Tuning, events: Events, track: Track, pictures: Sequence[Picture] = ()
) -> dict[str, Any]:
    """The same of a track, with what it was folded, and of what."""
    found = score(track, events, tuning.model, pictures, gate=tuning.gate, baseline=tuning.baseline)
    return {
        "estimator": estimator,
        "nis": _plain(found.nis),
        "nis_low": _plain(found.nis_low),
        "nis_high": _plain(found.nis_high),
        "nis_words": found.nis_verdict.words,
        "error": _error(found, tuning.model),
    }


def _error(found: Score, model: StateSpaceModel) -> dict[str, Any] | None:
    units = {state.name: state.unit for state in model.shown_states}
    rows = [row.unit for sensor in model.sensors for row in sensor.rows]
    units |= dict(zip(model.row_names, rows, strict=True))
    fits = [("truth", found.states), ("held out", found.held_out)]
    for against, part in fits:
        for name, fit in part.items():
            if math.isfinite(fit.rmse):
                coverage = _plain(fit.coverage)
                unit = units.get(name, "")
                return {"name": name, "rmse": fit.rmse, "unit": unit, "coverage": coverage, "against": against}
    return None


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
