"""What of the command line has to do with tunings: a dataclass for each command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from .words import Files, Settings, Twin


@dataclass(frozen=True)
class Commission:
    """Fold data on which everything was in order, and write what is normal there: alarms are then about changes.

    Prints the lines of the twin's YAML, or puts them there.
    """

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    estimator: str | None = None
    """Estimator to use instead of the twin's own."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Take only this many seconds of the source."""
    force: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Take the data for normal although sensors are refused or stuck in them, or the twin is lost."""
    write: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Put the section `commissioned` into the twin's YAML, in place of the one that is there."""


@dataclass(frozen=True)
class Tune:
    """Fit noises, parameters and options to recordings, and propose what predicts better what it was not fitted to.

    Each recording is cut into blocks of time: every third is held out, and judges. So does each sensor in turn,
    predicted by the others, and the true state where it is known. Exit status: 0 if something is proposed, 1 if not.
    """

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    fit: str = "Q,R"
    """What to fit: groups (Q, R, p, options, prior; over: how long the errors last that have a time) and single
    entries, as Q.winding, R.yoke, p.NAME, options.alpha, prior.STATE.std, with commas. scale: one factor for all of Q
    and R."""
    aim: Literal["witnesses", "likelihood", "crps", "error"] | None = None
    """What is maximised. likelihood: that of every reading before it was seen. witnesses: and of what a recording knows
    and the filter is never told, true states and sensors that the twin holds out. crps, error: how well sensors held
    out in turn are predicted, by continuous ranked probability score or squared error. Default: witnesses of a
    recording, likelihood of a simulation."""
    predict: tuple[str, ...] = ()
    """The sensors that those hold out. Default: each in turn."""
    estimator: str | None = None
    """Estimator to use instead of the twin's own; `nisus filters` lists all of them."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`: where the fit starts, and what is weakly believed."""
    log: Files = ()
    """Recording to fit to instead of the twin's own, repeatable: each is folded by itself; FILE,FILE are parts of one,
    and FILE@0.5 weighs half."""
    logs: int = 1
    """Number of logs of a simulated twin, with consecutive seeds."""
    duration: float | None = None
    """Take only this many seconds of each."""
    blocks: int = 9
    """Blocks of time, of as many readings each; every third is held out."""
    windows: str | None = None
    """Dual estimation: go through each log window after window of this length (600, 10min, 1h) as a running twin with
    `refit` does that adopts what is better, and print every parameter against time. A log that is shorter is one
    window."""
    every: str | None = None
    """Time between the ends of two windows. Default: the windows' length."""
    save: Path | None = None
    """Write what is proposed to this .yaml, as sections that stand in place of the twin's own; else nothing."""
    keep: str | None = None
    """Keep what is proposed beside the twin, as a tuning version of this name; see `nisus tunings`."""
    note: str = ""
    """What was tried; of --keep."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""


@dataclass(frozen=True)
class Learn:
    """Learn from recordings what a twin's model leaves out, as a correction with an uncertainty of its own.

    Each recording is cut into blocks of time: every third is held out, and there the twin is folded with the correction
    and without. Exit status: 0 if it is better there, 1 if not; then nothing is written.
    """

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    corrects: str
    """States whose rates are corrected, with commas: magnet."""
    features: str
    """States and inputs by which, with commas: speed,i_d,i_q."""
    kind: Literal["gp", "ridge", "net"] = "gp"
    """gp: a Gaussian process, which takes scikit-learn. ridge: ridge regression. net: a network of --net, judged only,
    which takes onnxruntime."""
    net: Path | None = None
    """ONNX file of --kind net: it takes features (N, d) and gives rates (N, k), units of the states a second."""
    degree: Literal[1, 2] = 1
    """Of ridge: 2 has squares and products of the features too."""
    window: float = 30.0
    """Seconds over which the physics is compared with what is known: the truth of the recording, else smoothed."""
    estimator: str | None = None
    """Estimator to use instead of the twin's own; `nisus filters` lists all of them."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    log: Files = ()
    """Recording to learn from instead of the twin's own, repeatable; FILE,FILE are parts of one."""
    duration: float | None = None
    """Take only this many seconds of each."""
    blocks: int = 9
    """Blocks of time, of as many readings each; every third is held out: of 3 the last."""
    keep: Path | None = None
    """Write the correction to this .yaml, which a twin's YAML then names: `learned: FILE`."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""


@dataclass(frozen=True)
class Guard:
    """Fold archived recordings with the accepted tunings of their twins, and say what got worse than recorded.

    Without a name: the twins that ship, with the logs that ship or lie under NISUS_DATA. What got worse by more than
    chance, or by so much that it says something of the asset, is a line of a table. Exit status: 0 if nothing did, 1 if
    something did, 2 if something could not be folded. What is absent is said; with CI=true it is an error.
    """

    twins: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names of twins that ship, or paths of YAML files."""
    archive: Path | None = None
    """Folder of recordings (.rrd) and of twins (.yaml) to guard."""
    junit: Path | None = None
    """Also write the verdict to this file, as JUnit XML for CI."""
    accept: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Record the scores as they are now: what guards compare with from then on."""
    note: str = ""
    """Why; of --accept, which keeps it with the scores."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`: what becomes of the scores under another setting."""
    jobs: int | None = None
    """Number of processes; default: one for each processor."""


@dataclass(frozen=True)
class Tunings:
    """List the tuning versions of a twin, compare two of them, keep one or accept one.

    They are kept beside the twin, FILE.tunings/NAME.yaml of FILE.yaml; those of a twin that ships in the user's data
    folder. `own` is what the twin's file says.
    """

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Two versions: the entries in which they differ, and their scores."""
    save: str | None = None
    """Keep what --tuning, --estimator and --set make of the twin as a version of this name, with its scores."""
    accept: str | None = None
    """Accept the version of this name: from then on it is the one that `nisus guard` folds with."""
    note: str = ""
    """Why, or what was tried; of --save and --accept."""
    estimator: str | None = None
    """Of --save: estimator to use instead of the twin's own."""
    set: Settings = ()
    """Of --save: KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Of --save: version to begin with. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Of --save: recordings to score it on instead of the twin's own."""
    duration: float | None = None
    """Of --save: take only this many seconds of the source."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""
