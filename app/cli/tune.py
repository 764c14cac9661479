"""`nisus tune`: fit a tuning to recordings, and propose it if it predicts held-out data better."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from config.loader import find
from config.yaml_files import shown_path, writing
from estimators.errors import ConfigError, printable
from estimators.fit.aims import CRPS, ERROR, LIKELIHOOD
from estimators.fit.dual import WindowFit, tail, walk
from estimators.fit.entries import check_key
from estimators.fit.fit import Fitted, fit
from estimators.fit.objective import FitProgress
from estimators.fit.recording import BLOCKS, Recording
from sources.formats import check_once

from ..render.text import to_text
from ..study.fit_json import fit_json
from ..study.fold_result import rows_of
from ..study.processes import executor_of
from ..study.tune import fit_text, heading, sections, window_json, window_topics, windows_verdict
from ..terminal import complain
from ..twin.defaults import bounds_of, natural_aim, width_priors
from ..twin.log_reader import read_log, read_logs
from ..twin.tuning_yaml import tuning_yaml
from ..twin.twin import Twin, load_twin, with_held
from ..twin.versions import apply_tuning, check_free, keep, settings_of, version_text, widths_of
from .arguments import TuneCommand as Arguments
from .options import check_output, names_of, overrides_of, seconds_of, span_of
from .prepare import attend, fold_log, prepare

MIN_BLOCKS = 3  # least number of blocks, of which one is held out


def tune_twin(arguments: Arguments) -> int:
    """Fit entries of the tuning, and print the verdict."""
    wanted = names_of(arguments.fit)
    if not wanted:
        raise ConfigError("--fit names nothing; write for example --fit Q,R")
    plain = arguments.belief == "none"
    blocks = (0 if plain else BLOCKS) if arguments.blocks is None else arguments.blocks
    if blocks < MIN_BLOCKS and blocks:
        raise ConfigError(f"--blocks {blocks}: must be {MIN_BLOCKS} or more, or 0 to hold nothing out")
    if arguments.predict and arguments.aim not in (CRPS, ERROR):
        raise ConfigError("--predict: is for --aim crps and --aim error; the likelihood is that of every sensor")
    if arguments.save is not None:
        check_output("--save", arguments.save, ".yaml", ".yml")
    if arguments.out is not None:
        check_output("--out", arguments.out, ".yaml", ".yml", new="choose another name, or use --apply")
    if arguments.keep is not None:
        check_free(find(arguments.twin), arguments.keep)
    if arguments.windows is not None:
        if plain or not blocks:
            given = "--belief none" if plain else "--blocks 0"
            raise ConfigError(f"{given}: cannot be used with --windows, whose fits are judged one by one; omit it")
        return tune_windows(arguments, wanted, arguments.windows, blocks)
    if arguments.every is not None:
        raise ConfigError("--every: is the time between the ends of two --windows; give both")
    twin, recordings = _recordings(arguments, wanted)
    aim = arguments.aim or (LIKELIHOOD if plain else natural_aim(twin.config))
    held = with_held(twin)
    prepare(held)

    state = FitProgress()

    def work() -> Fitted:
        return fit(
            twin.estimator,
            held.tuning,
            recordings,
            wanted=wanted,
            bounds=bounds_of(twin.config, held.model),
            blocks=blocks,
            aim=aim,
            predict=arguments.predict,
            considered=width_priors(twin.config, held.model, wanted),
            penalised=not plain,
            progress=state,
            executor=executor,
        )

    with _executor(arguments, twin, held) as executor:
        found: Fitted = _attend_fit(twin, work, state, "fitting")
    if arguments.json:
        print(json.dumps({"twin": twin.name, **fit_json(found)}, allow_nan=False))
    else:
        written = arguments.apply or any((arguments.out, arguments.save, arguments.keep))
        print(to_text(sections(twin, found, aim, written=written)))
    if not found.proposed:
        return 1
    _save(arguments, twin, found, arguments.log or (f"{twin.name}, its own log",))
    return 0


def _executor(arguments: Arguments, twin: Twin, held: Twin) -> AbstractContextManager[Executor | str]:
    return executor_of(arguments.cluster, twin, held, arguments.twin, overrides_of(arguments))


def _attend_fit(
    twin: Twin, work: Callable[[], object], state: FitProgress, doing: str, text: Callable[[], str] = str
) -> Any:
    """Run a fit with its progress; Ctrl-C ends it with the best values so far."""

    def stop() -> None:
        state.stop = True

    begun = time.monotonic()
    return attend(twin.model, work, doing, text=lambda: text() + fit_text(state, time.monotonic() - begun), stop=stop)


def _save(arguments: Arguments, twin: Twin, found: Fitted, fitted_on: Sequence[str]) -> None:
    """Write a proposed tuning to the twin's YAML, to the file of `--save` and to the version of `--keep`."""
    if arguments.apply or arguments.out is not None:
        own, widths = load_twin(arguments.twin), widths_of(twin, found)
        complain(apply_tuning(own, found.estimator, *found.setting, widths=widths, out=arguments.out))
    if arguments.save is not None:
        text = heading(twin, found)
        text += tuning_yaml(twin.config, twin.estimator, *found.setting, widths=widths_of(twin, found))
        with writing(arguments.save, "--save"):
            arguments.save.write_text(text, encoding="utf-8")
    if arguments.keep is not None:
        settings = settings_of(twin, found, list(fitted_on), printable(arguments.note))
        complain(f"{shown_path(keep(twin, arguments.keep, version_text(twin, settings)))}: kept")


def _recordings(arguments: Arguments, wanted: Sequence[str]) -> tuple[Twin, list[Recording]]:
    """Return the twin, and its recordings, simulated logs, or own log."""
    overrides = overrides_of(arguments)
    if not arguments.log:
        twin = load_twin(arguments.twin, overrides=overrides)
        _prepare_fit(arguments, wanted, twin)
        logs = read_logs(twin, arguments.twin, overrides, arguments.logs, arguments.duration)
        return twin, [_part(arguments, twin, Recording(log)) for log in logs]
    if arguments.logs != 1:
        raise ConfigError("--logs: is for a simulated twin; a recording is named by --log, once each")
    named = [_named(text) for text in arguments.log]
    check_once([file.expanduser() for files, _ in named for file in files], "--log ")
    twins = [load_twin(arguments.twin, log_files=files, overrides=overrides) for files, _ in named]
    _prepare_fit(arguments, wanted, twins[0])
    logs = [read_log(twin, arguments.duration)[0] for twin in twins]
    recordings = [Recording(log, weight) for log, (_, weight) in zip(logs, named, strict=True)]
    return twins[0], [_part(arguments, twins[0], item) for item in recordings]


def _prepare_fit(arguments: Arguments, wanted: Sequence[str], twin: Twin) -> None:
    """Compile the twin's filter and model. Keys of no entry are refused before, as compiling can take a minute."""
    fitted = with_held(twin) if arguments.windows is None else twin
    for key in wanted:
        check_key(twin.estimator, fitted.tuning, key)
    prepare(twin)


def _part(arguments: Arguments, twin: Twin, recording: Recording) -> Recording:
    """Return the part of a recording that `--since` and `--until` select, with the state of the filter before it."""
    log = recording.log
    part = rows_of(log, span_of(arguments, log.events))
    if part == slice(0, log.n):
        return recording
    log.n = part.stop
    fold = fold_log(twin, log)
    if fold.failure is not None:
        raise fold.failure
    log, base = tail(fold, part.start)
    return recording._replace(log=log, base=base)


def _named(text: str) -> tuple[list[Path], float]:
    """Files and weight of `FILE,FILE@WEIGHT`.

    Raises:
        ConfigError: If the weight is no positive number.
    """
    files, at, weight = text.rpartition("@")
    try:
        number = float(weight) if at else None
    except ValueError:
        number = None  # a file may have such a name
    if number is None:
        return [Path(part) for part in text.split(",")], 1.0
    if not 0.0 < number < float("inf"):
        raise ConfigError(f"--log {text}: the weight is {weight}; it must be positive")
    return [Path(part) for part in files.split(",")], number


def tune_windows(arguments: Arguments, wanted: Sequence[str], windows: str, blocks: int) -> int:
    """Fit window after window; return 0 if something was adopted, else 1."""
    window = seconds_of("--windows", windows)
    every = window if arguments.every is None else seconds_of("--every", arguments.every)
    if arguments.since is not None or arguments.until is not None:
        raise ConfigError("--since and --until: cannot be used with --windows, which go through the whole log")
    if arguments.aim not in (None, LIKELIHOOD):
        raise ConfigError(
            f"--aim {arguments.aim}: cannot be used with --windows, which are fitted by likelihood; omit it"
        )
    twin, given = _recordings(arguments, wanted)
    if any(item.weight != 1.0 for item in given):
        raise ConfigError("--log: with --windows each recording follows the one before; leave the weights out")

    state = FitProgress()
    found: list[tuple[int, WindowFit]] = []

    def work() -> None:
        tuning = twin.tuning
        for k, item in enumerate(given):
            for refit in walk(
                twin.estimator,
                tuning,
                item.log,
                wanted=wanted,
                window=window,
                every=every,
                bounds=bounds_of(twin.config, twin.model),
                blocks=blocks,
                progress=state,
                executor=executor,
            ):
                # Its rows are many and not needed here.
                found.append((k, refit._replace(lived=refit.lived.select(slice(0, 0)).copy())))
                if refit.fitted is not None and refit.proposed:
                    tuning = refit.fitted.setting.tuning
            if state.stop:
                return

    with _executor(arguments, twin, with_held(twin)) as executor:
        _attend_fit(twin, work, state, "fitting window after window", lambda: f"window {len(found) + 1}: ")
    origins = [int(item.log.t[0]) for item in given]
    ends = [int(item.log.t[item.log.n - 1]) for item in given]
    if arguments.json:
        listed = [window_json(k, refit, origins[k]) for k, refit in found]
        print(json.dumps({"twin": twin.name, "window": window, "every": every, "windows": listed}, allow_nan=False))
    else:
        print(to_text([*window_topics(found, origins), windows_verdict(twin, found, origins, ends)]))
    adopted = [refit.fitted for _, refit in found if refit.fitted is not None and refit.proposed]
    if not adopted:
        return 1
    names = ", ".join(arguments.log or (f"{twin.name}, its own log",))
    _save(arguments, twin, adopted[-1], [f"{names}: windows of {window:g} s"])
    return 0
