"""`nisus tune`: fit a twin's tuning to recordings, and say whether what was found is better."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from config.files import shown_path
from config.loader import find
from config.source_schema import SimulatorSection
from estimators.errors import ConfigError, printable
from estimators.fit.aims import CRPS, ERROR
from estimators.fit.fit import Fitted, fit
from estimators.fit.recording import Recording
from estimators.log import Log

from ..live.runs.runs_json import fit_json
from ..live.tunings.fitted import settings_of
from ..live.tunings.tuning_yaml import tuning_yaml
from ..live.tunings.versions import check_free, keep, version_text
from ..present.result import to_text
from ..terminal import complain
from ..twin.bounds import bounds_of, natural_aim
from ..twin.twin import Twin, load_twin
from .fold import read_log
from .given import settings
from .places import check_place
from .prepare import attend, prepare
from .tune_text import heading, sections
from .tune_windows import tune_windows

if TYPE_CHECKING:
    from .arguments import Tune as Arguments

FEWEST = 3
"""Blocks, with which one is held out."""


def tune_twin(arguments: Arguments) -> int:
    """Carry the command out."""
    wanted = [key.strip() for key in arguments.fit.split(",") if key.strip()]
    if not wanted:
        raise ConfigError("--fit names nothing; write for example --fit Q,R")
    if arguments.blocks < FEWEST:
        raise ConfigError(f"--blocks {arguments.blocks}: must be {FEWEST} or more, or nothing is held out")
    if arguments.predict and arguments.aim not in (CRPS, ERROR):
        raise ConfigError("--predict: is for --aim crps and --aim error; the likelihood is that of every sensor")
    if arguments.save is not None:
        if arguments.save.suffix not in (".yaml", ".yml"):
            raise ConfigError(f"--save {arguments.save}: must end in .yaml")
        check_place("--save", arguments.save)
    if arguments.keep is not None:
        check_free(find(arguments.twin), arguments.keep)
    if arguments.windows is not None:
        return tune_windows(arguments, wanted, _recordings)
    if arguments.every is not None:
        raise ConfigError("--every: is the time between the ends of two --windows; give both")
    twin, recordings = _recordings(arguments)
    aim = arguments.aim or natural_aim(twin.config)

    def work() -> Fitted:
        return fit(
            twin.estimator,
            twin.tuning,
            recordings,
            wanted=wanted,
            bounds=bounds_of(twin.config, twin.model),
            blocks=arguments.blocks,
            aim=aim,
            predict=arguments.predict,
        )

    found: Fitted = attend(twin.model, work, "fitting")
    if arguments.json:
        print(json.dumps({"twin": twin.name, **fit_json(found)}, allow_nan=False))
    else:
        print("\n".join(to_text(sections(twin, found))))
    if arguments.save is not None and found.proposed:
        text = heading(twin, found) + tuning_yaml(twin.config, twin.estimator, *found.setting)
        arguments.save.write_text(text, encoding="utf-8")
    if arguments.keep is not None and found.proposed:
        fitted_on = arguments.log or (f"{twin.name}, its own log",)
        given = settings_of(found, [str(name) for name in fitted_on], printable(arguments.note))
        complain(f"{shown_path(keep(twin, arguments.keep, version_text(twin, given)))}: kept")
    return 0 if found.proposed else 1


def _recordings(arguments: Arguments) -> tuple[Twin, list[Recording]]:
    """The twin, and what it is fitted to: recordings, logs of its simulator, or its own log."""
    overrides = settings(arguments.set, arguments.estimator)
    if not arguments.log:
        twin = load_twin(arguments.twin, overrides=overrides)
        prepare(twin)
        return twin, [Recording(log) for log in _own(twin, arguments, overrides)]
    if arguments.logs != 1:
        raise ConfigError("--logs: is for a simulated twin; a recording is named by --log, once each")
    named = [_named(text) for text in arguments.log]
    twins = [load_twin(arguments.twin, log_files=files, overrides=overrides) for files, _ in named]
    prepare(twins[0])
    logs = [read_log(twin, arguments.duration)[0] for twin in twins]
    return twins[0], [Recording(log, weight) for log, (_, weight) in zip(logs, named, strict=True)]


def _named(text: str) -> tuple[list[Path], float]:
    """Files and weight of `FILE,FILE@WEIGHT`.

    Raises:
        ConfigError: If the weight is no positive number.
    """
    files, at, weight = text.rpartition("@")
    if not at:
        return [Path(part) for part in text.split(",")], 1.0
    try:
        number = float(weight)
    except ValueError:
        # A file may have such a name.
        return [Path(part) for part in text.split(",")], 1.0
    if not 0.0 < number < float("inf"):
        raise ConfigError(f"--log {text}: the weight is {weight}; it must be positive")
    return [Path(part) for part in files.split(",")], number


def _own(twin: Twin, arguments: Arguments, overrides: dict[str, str]) -> list[Log]:
    if arguments.logs == 1:
        return [read_log(twin, arguments.duration)[0]]
    source = twin.config.source
    if arguments.logs < 1:
        raise ConfigError(f"--logs {arguments.logs}: must be 1 or more")
    if not isinstance(source, SimulatorSection):
        raise ConfigError(f"--logs {arguments.logs}: {twin.name} is not simulated; name recordings by --log")
    seeds = range(source.seed, source.seed + arguments.logs)
    twins = (load_twin(arguments.twin, overrides={**overrides, "source.seed": str(seed)}) for seed in seeds)
    return [read_log(other, arguments.duration)[0] for other in twins]
