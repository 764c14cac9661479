"""`nisus learn`: learn the model error of a twin from recordings, and judge the corrected twin."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from app.cli.options import check_output, names_of, overrides_of
from app.cli.prepare import attend, prepare
from app.render.text import to_text
from app.result import to_json
from app.terminal import complain
from app.twin.log_reader import read_log
from app.twin.model import physics_of
from app.twin.twin import Twin, load_twin
from config.yaml_files import shown_path, writing
from estimators.errors import ConfigError
from estimators.fit.entries import Setting
from estimators.fit.judge import PartScore, worths
from estimators.fit.recording import Recording, held_out_rows
from estimators.model.hybrid import check_places
from estimators.model.state_space import StateSpaceModel
from estimators.registry import find_estimator
from estimators.smoothing.smooth import check_smooth
from estimators.tuning import Tuning

from .arguments import LearnCommand as Arguments
from .correction import run_net
from .lesson import Lesson, as_dict, correction_text, noises_of, scores_of, sections
from .train import NET, Trained, against, on_windows, train
from .windows import Windows, known_states, windows

MIN_BLOCKS = 3  # least number of blocks, of which one is held out
STRETCHES = 9  # long parts of each recording over which errors add up to choose between candidates


def learn_correction(arguments: Arguments) -> int:
    """Learn the model error of a twin; return 0 if the correction is better, else 1."""
    corrects, features = names_of(arguments.corrects), names_of(arguments.features)
    for option, names in (("--corrects", corrects), ("--features", features)):
        if not names:
            raise ConfigError(f"{option} names nothing; write names with commas")
    _check(arguments)
    net = None if arguments.net is None else run_net(arguments.net, len(features), len(corrects))
    overrides = {**overrides_of(arguments), "correction": "null"}
    twins = [
        load_twin(arguments.twin, log_files=files or None, overrides=overrides)
        for files in ([Path(part) for part in text.split(",") if part] for text in arguments.log or ("",))
    ]
    twin = twins[0]
    physics = _tuned_physics(twin)
    check_places(physics, corrects, features)
    check_smooth(find_estimator(twin.estimator, twin.model), twin.model, twin.tuning.options)
    prepare(twin)
    logs = [read_log(each, arguments.duration)[0] for each in twins]

    def cut() -> Windows:
        parts = []
        for log in logs:
            fold = twin.fold(log)
            fold.advance()
            held_out = held_out_rows(log, arguments.blocks)
            parts.append(
                windows(
                    physics,
                    log,
                    known_states(fold, physics),
                    held_out,
                    corrects=corrects,
                    features=features,
                    seconds=arguments.window,
                    stretches=STRETCHES,
                )
            )
        return Windows.joined(parts)

    given: Windows = attend(twin.model, cut, "comparing the physics with the states")
    own, apart = given.of(~given.held_out), given.of(given.held_out)

    def learn() -> Trained:
        return train(arguments.kind, own, names=features, degree=arguments.degree, net=net)

    trained: Trained = attend(twin.model, learn, "learning")
    own_noise, _ = noises_of(physics, trained, corrects)

    def text(net: Path | None, scores: Mapping[str, float] | None = None) -> str:
        on = arguments.log or (f"{twin.name} (log of its YAML)",)
        return correction_text(twin, physics, trained, corrects, features, learned_on=on, net=net, scores=scores)

    with tempfile.TemporaryDirectory(prefix="nisus-") as folder:
        file = Path(folder) / "correction.yaml"
        file.write_text(text(arguments.net and arguments.net.absolute()), encoding="utf-8")
        corrected = load_twin(arguments.twin, overrides={**overrides, "correction": str(file)})
    wider = {name: float(trained.before[k]) for k, name in enumerate(corrects) if name in own_noise}
    tunings = twin.tuning, _tuned(twin.tuning, wider), _tuned(corrected.tuning, own_noise)
    recordings = [Recording(log, 1.0, held_out_rows(log, arguments.blocks)) for log in logs]

    def judge() -> list[PartScore]:
        return [
            worths(twin.estimator, [Setting(each, None)], recordings, lambda folds: True)[0].held_out
            for each in tunings
        ]

    parts: list[PartScore] = attend(twin.model, judge, "judging")
    lesson = Lesson(
        corrects=corrects,
        units=tuple(physics.states[physics.state_names.index(name)].unit for name in corrects),
        words=trained.words,
        learned_from=on_windows(trained, own, trained.rest),
        held_out=on_windows(trained, apart) if len(apart.start) else None,
        parts=tuple(parts),
        noise=own_noise,
        reasons=against(parts[:2], parts[2], corrects),
    )
    if arguments.json:
        print(to_json({"twin": twin.name, **as_dict(lesson)}))
    else:
        print(to_text(sections(twin.name, arguments.window, lesson, arguments.keep)))
    if lesson.better and arguments.keep is not None:
        with writing(arguments.keep, "--keep"):
            arguments.keep.write_text(text(_beside(arguments.net, arguments.keep), scores_of(lesson)), encoding="utf-8")
        complain(f"{shown_path(arguments.keep)}: kept")
    return 0 if lesson.better else 1


def _check(arguments: Arguments) -> None:
    """Refuse wrong numbers and files before the work."""
    if arguments.blocks < MIN_BLOCKS:
        raise ConfigError(f"--blocks {arguments.blocks}: must be {MIN_BLOCKS} or more, or nothing is held out")
    if not arguments.window > 0.0:
        raise ConfigError(f"--window {arguments.window:g}: must be positive")
    if (arguments.kind == NET) != (arguments.net is not None):
        raise ConfigError("--net FILE.onnx: is for --kind net, which needs it")
    if arguments.keep is not None:
        check_output("--keep", arguments.keep, ".yaml", ".yml")


def _tuned_physics(twin: Twin) -> StateSpaceModel:
    """Return the twin's own model with tuned parameters, without appended states."""
    physics = physics_of(twin.loaded)
    values = dict(zip((item.name for item in twin.model.parameters), twin.tuning.p.tolist(), strict=True))
    parameters = tuple(replace(item, value=values.get(item.name, item.value)) for item in physics.parameters)
    return replace(physics, parameters=parameters)


def _tuned(tuning: Tuning, noise: Mapping[str, float]) -> Tuning:
    for name, variance in noise.items():
        tuning = tuning.set(f"Q.{name}", variance)
    return tuning


def _beside(net: Path | None, keep: Path) -> Path | None:
    """The net's path as the correction's file names it: relative where it lies in the same folder."""
    if net is None:
        return None
    near, folder = net.absolute(), keep.absolute().parent
    return near.relative_to(folder) if near.is_relative_to(folder) else near
