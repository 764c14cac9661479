"""The recording: an .rrd file that Rerun opens, and that holds all it takes to fold again, to the bit.

Beside what charts show, the file keeps under /nisus, as plain columns: `twin` (YAML, estimator, base), `tuning` (each
one, with the event from which it held), `events` (the log), `track` (float64) and `notices` (lines for people). Rows
carry their absolute index; a late reading makes a recorder write rows again from the index where it belongs, and
another revision from the start. `recorded` reads them back.
"""

from __future__ import annotations

import atexit
import base64
import ctypes
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr

from estimators.errors import SourceError
from estimators.fold import Base
from estimators.model.state_space import StateSpaceModel
from estimators.tuning import Tuning

from ..engine.outputs import Pull

FORMAT = 1
PREFIX = "nisus_"
"""Of the name under which a recording is known to Rerun; the twin's follows."""
TIMELINE = "event"
PATIENCE = 5.0
"""Seconds for a file to take what it is given; Rerun would wait for ever on one that takes no more."""


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
            "options": dict(tuning.options),
            "seed": tuning.seed,
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
        options=values["options"],
        seed=values["seed"],
    )
    return tuning, values["estimator"]


def base_to_json(base: Base | None) -> str:
    """A base as text; float64s survive exactly."""
    if base is None:
        return "null"
    moments = {"mean": base.mean.tolist(), "cov": base.cov.tolist(), "clock": base.clock, "u": base.u.tolist()}
    if base.state is None:
        return json.dumps(moments)
    state = base64.b64encode(np.ascontiguousarray(base.state, "<f8").tobytes()).decode()
    return json.dumps({**moments, "estimator": base.estimator, "state": state})


def base_from_json(text: str) -> Base | None:
    """The base that `base_to_json` wrote; older recordings hold moments only."""
    values = json.loads(text)
    if values is None:
        return None
    state = values.get("state")
    return Base(
        np.array(values["mean"]),
        np.array(values["cov"]),
        int(values["clock"]),
        np.array(values["u"], float),
        values.get("estimator", ""),
        None if state is None else np.frombuffer(base64.b64decode(state), "<f8").astype(float),
    )


class RecordingFile:
    """An .rrd that is being written, in a stream of its own: no viewer can hold it up."""

    def __init__(self, path: Path, *, name: str, text: str, twin_path: Path, base: Base | None) -> None:
        """Begin a file.

        Args:
            path: Where; the folder must exist.
            name: Of the twin.
            text: The twin's YAML.
            twin_path: Where the YAML was, for the model's file beside it.
            base: Where the fold of the first event starts, if older events were dropped before.

        Raises:
            SourceError: If the file cannot be written.
        """
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("wb").close()
        except OSError as error:
            raise SourceError(f"recording {path}: {error.strerror}; choose a place that can be written") from None
        self.stream = rr.RecordingStream(f"{PREFIX}{name}", recording_id=f"{name}-{path.stem}")
        self.stream.set_sinks(rr.FileSink(str(path)))
        self.rows = 0
        self.stream.log(
            "/nisus/twin",
            rr.AnyValues(format=FORMAT, name=name, yaml=text, path=str(twin_path), base=base_to_json(base)),
            static=True,
        )

    def tuning(self, tuning: Tuning, estimator: str, index: int, revision: int) -> None:
        """Write the tuning that holds from event `index` on."""
        self.stream.send_columns(
            "/nisus/tuning",
            indexes=[rr.TimeColumn(TIMELINE, sequence=[index])],
            columns=rr.AnyValues.columns(json=[tuning_to_json(tuning, estimator)], revision=[revision]),
        )

    def write(self, pull: Pull) -> None:
        """Write rows of log and track, and the lines for people."""
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
        count = len(pull.readings)
        if not count:
            return
        index = [rr.TimeColumn(TIMELINE, sequence=np.arange(pull.first, pull.first + count))]
        for entity, columns in (("/nisus/events", pull.readings), ("/nisus/track", pull.track)):
            # As Arrow's arrays: Rerun would turn NumPy's into Python lists, which takes fifty times as long.
            flat: dict[str, pa.Array] = {}
            for name, column in zip(columns._fields, columns, strict=True):
                if column.ndim == 1:
                    flat[name] = pa.array(column)
                else:
                    flat |= {f"{name}_{k}": pa.array(column[:, k]) for k in range(column.shape[1])}
            self.stream.send_columns(entity, indexes=index, columns=rr.AnyValues.columns(**flat))
        self.rows += count

    def flush(self) -> None:
        """Hand everything to the operating system."""
        self.stream.flush(timeout_sec=PATIENCE)

    def abandon(self) -> None:
        """Leave a file that takes no more as it is.

        Rerun waits without end for what cannot be written, when the stream is dropped and when the process ends. So
        the stream is never dropped, and the process does not ask.
        """
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self.stream))
        atexit.unregister(rr.rerun_shutdown)

    def close(self) -> None:
        """Finish the file."""
        self.stream.flush(timeout_sec=PATIENCE)
        self.stream.disconnect()
