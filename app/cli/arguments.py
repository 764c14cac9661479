"""What can be asked on the command line: a dataclass for each command, and `--set KEY=VALUE`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args, get_type_hints

import tyro

from estimators.errors import ConfigError, quoted

Twin = Annotated[str, tyro.conf.Positional]
Settings = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
Files = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]


@dataclass(frozen=True)
class Run:
    """Run a twin, and show it in the browser; without a name, the gallery of all that ship."""

    twin: Annotated[str | None, tyro.conf.Positional] = None
    """Name of a twin that ships (see `nisus twins`), or path of a YAML file. Default: the gallery, to choose one."""
    estimator: str | None = None
    """Estimator to use instead of the twin's own; `nisus filters` lists all of them."""
    set: Settings = ()
    """KEY=VALUE, repeatable: Q.temperature=0.02, R.winding=9, p.NAME, use.SENSOR=false, gate, or a dotted YAML key."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    record: Path | None = None
    """Record into this .rrd file from the start."""
    record_split: str | None = None
    """Go on in another file, run-2.rrd after run.rrd, when one has grown so large or so long: 1GB, 10min."""
    speed: float | None = None
    """Speed of replays and simulations, as a multiple of real time; inf is as fast as possible. Default: the twin's."""
    duration: float | None = None
    """Stop after this many seconds."""
    port: int = 9900
    """Port of the page, on 127.0.0.1; 0 picks a free one."""
    recordings: Path = Path("recordings")
    """Folder of what the page records, lists, and is given by dropping it there; made when it is needed."""
    no_browser: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the URL without opening a browser."""
    headless: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Run without a page; record if asked to."""


@dataclass(frozen=True)
class Fold:
    """Fold a twin's readings as fast as possible, and print what the estimate was worth."""

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    estimator: str | None = None
    """Estimator to use instead of the twin's own; `nisus filters` lists all of them."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Take only this many seconds of the source."""
    out: Path | None = None
    """Write the track to this .csv or .parquet, or a recording to this .rrd."""
    html: Path | None = None
    """Write a report to this HTML file, which needs no other: scores, charts, checks, episodes, tuning."""
    smooth: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Smooth too: what the readings before and after each moment say of it; a .csv or .parquet has it beside."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""


@dataclass(frozen=True)
class Check:
    """Say what could be wrong with a twin unnoticed: a checklist with measured figures, on one page.

    Linearity, size, shape of the posterior, observability, the smallest visible fault of every sensor, input and
    parameter, how wrong each state can be by one that nobody sees, timing, health, and every sensor held out in turn
    beside the model without any reading.
    """

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    estimator: str | None = None
    """Estimator to use instead of the twin's own; `nisus filters` lists all of them."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Take only this many seconds of the source."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""
    html: Path | None = None
    """Also write the page to this HTML file, which needs no other."""


@dataclass(frozen=True)
class Advise:
    """Say which estimator a twin needs, by what its log shows; or draft a twin of a recording that has none.

    Of a twin: the simplest estimator whose assumptions the recorded data pass, each claim with the figure that made it,
    and the lines for its YAML. Of a recording: rates, holes, noise, which signals say the same, what drives what.
    """

    what: Annotated[tuple[str, ...], tyro.conf.Positional]
    """A twin that ships, or the path of a YAML file; or recordings."""
    estimator: str | None = None
    """Estimator to start from instead of the twin's own."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Take only this many seconds of the twin's source."""
    dbc: Files = ()
    """Of recordings: DBC file of their frames, repeatable; FILE@BUS where it holds on one bus only."""
    signals: str = ""
    """Of recordings: A,B, the signals to take, as for `new`."""
    time: str | None = None
    """Of recordings: column of a table that holds the time; default: the one of such a name."""
    time_unit: str = "s"
    """Of recordings: its unit: s, ms, us, ns, min or h."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""
    apply: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Put the lines into the twin's YAML; the file as it was is kept beside it."""
    out: Path | None = None
    """Write the YAML with the lines in it to this file, in the same folder if it names files beside it; of recordings
    write the draft, NAME.yaml and NAME.py."""


@dataclass(frozen=True)
class Compare:
    """Fold every filter that applies over the same log, in parallel, and print what each estimate was worth.

    A filter that draws its members folds eight times, with another seed each; its figures are mean ± standard
    deviation of one fold. A step is one event of the log; its cost is that of one processor.
    """

    twin: Twin
    """Name of a twin that ships, path of a YAML file, or `all`: each that ships."""
    estimators: tuple[str, ...] = ()
    """Compare only these filters."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Take only this many seconds of the source."""
    logs: int = 1
    """Number of logs of a simulated twin, with consecutive seeds; figures are mean ± standard deviation over them."""
    budget: float = 20.0
    """CPU seconds allowed for one filter; a slower filter folds a shorter span, which its row states."""
    jobs: int | None = None
    """Number of processes; default: one for each processor."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON list."""
    write: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep the table as CSV: config/scores/NAME.csv for a twin that ships, NAME.scores.csv beside any other YAML."""


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
class Stress:
    """Make mistakes with a twin on purpose, and print how soon, and how rightly, it says so.

    Errors of the tuning hold from the start; faults of what the source says from a third to two thirds of the log, so
    that false alarms before and recovery after them show too. Figures are medians over the seeds.
    """

    twin: Twin
    """Name of a twin that ships, or path of a YAML file."""
    estimators: tuple[str, ...] = ()
    """The filters to try. Default: the twin's own."""
    only: tuple[str, ...] = ()
    """Only mistakes whose name holds one of these texts."""
    list: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """List the mistakes, and make none."""
    seeds: int = 3
    """Number of seeds, of the simulated asset, the faults and the filter."""
    duration: float = 600.0
    """Seconds of the log."""
    set: Settings = ()
    """KEY=VALUE, repeatable, as for `run`."""
    tuning: str | None = None
    """Tuning version to begin with, by name; `nisus tunings TWIN` lists them. Default: what the twin's file says."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON list, an object for each mistake, filter and seed."""


@dataclass(frozen=True)
class Filters:
    """List the estimators: what they assume, their options, what they cost and when they fail."""

    twin: str | None = None
    """Name or YAML file of a twin: which filters apply to it, what they cost there, and why the others do not apply."""


@dataclass(frozen=True)
class Review:
    """Open a recording on the page, with a panel that can fold its readings again."""

    file: Annotated[Path, tyro.conf.Positional]
    """The .rrd file."""
    port: int = 9900
    """Port of the page, on 127.0.0.1; 0 picks a free one."""
    recordings: Path = Path("recordings")
    """Folder of what the page records, lists, and is given by dropping it there; made when it is needed."""
    no_browser: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the URL without opening a browser."""
    duration: float | None = None
    """Stop after this many seconds."""


@dataclass(frozen=True)
class Bus:
    """Play a twin's asset on its CAN bus, in a process of its own."""

    twin: Twin
    """Name of a twin with a CAN source that has an `asset`, or path of a YAML file."""
    interface: str = "udp_multicast"
    """python-can's name of the bus: udp_multicast reaches other processes of this machine, socketcan a real bus."""
    channel: str | None = None
    """Channel of the interface; default: the twin's where it suits, else the interface's own."""
    set: Settings = ()
    """KEY=VALUE of the YAML, repeatable."""
    duration: float | None = None
    """Stop after this many seconds."""
    record: Path | None = None
    """Also write the frames to this log, in any format python-can writes (.blf, .asc, .log, .csv, .mf4)."""


@dataclass(frozen=True)
class Twins:
    """List the twins that ship, or describe one: what to expect of it, and how every filter scored."""

    name: Annotated[str | None, tyro.conf.Positional] = None
    """Of a twin that ships, or path of a YAML file."""
    picture: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Draw its picture for the gallery from a fold of its log, or those of all: config/cards/NAME.svg, or NAME.svg
    beside any other YAML."""


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


@dataclass(frozen=True)
class Schema:
    """Write the JSON Schema of a twin's YAML, for editors that complete and check."""

    out: Path | None = None
    """File; without it, standard output."""


@dataclass(frozen=True)
class Log:
    """List what recordings hold: buses, messages, signals or columns, with rates, spans and holes."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """CAN logs (MF4, BLF, ASC, TRC, candump, CSV, SQLite) or tables (CSV, Parquet, MATLAB, NumPy), in their order."""
    dbc: Files = ()
    """DBC file that names messages and signals, repeatable; FILE@BUS where it holds on one bus only."""
    time: str | None = None
    """Column of a table that holds the time; default: the one of such a name."""
    time_unit: str = "s"
    """Its unit: s, ms, us, ns, min or h."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object."""


@dataclass(frozen=True)
class New:
    """Write a working pair NAME.yaml and NAME.py to start a twin of your own from: a pump, or a recording's signals."""

    name: Annotated[str, tyro.conf.Positional]
    """Name of the twin."""
    folder: Path = field(default_factory=Path.cwd)
    """Folder to write to."""
    log: tuple[Path, ...] = ()
    """Recordings whose signals become its sensors."""
    dbc: Files = ()
    """DBC file of their frames, repeatable; FILE@BUS where it holds on one bus only."""
    signals: str = ""
    """A,B: signals (SIGNAL or MESSAGE.SIGNAL) or columns to take; default: those that vary most finely, at most 6."""
    time: str | None = None
    """Column of a table that holds the time; default: the one of such a name."""
    time_unit: str = "s"
    """Its unit: s, ms, us, ns, min or h."""


Command = (
    Run
    | Fold
    | Check
    | Advise
    | Compare
    | Tune
    | Learn
    | Guard
    | Stress
    | Commission
    | Filters
    | Review
    | Bus
    | Twins
    | Tunings
    | Schema
    | Log
    | New
)
COMMANDS: dict[str, type] = {command.__name__.lower(): command for command in get_args(Command)}


def settings(given: Sequence[str], estimator: str | None = None, tuning: str | None = None) -> dict[str, str]:
    """The KEY=VALUE pairs of `--set`, with `--estimator` and `--tuning` as two more.

    Raises:
        ConfigError: If one has no `=`, or no key before it.
    """
    pairs: dict[str, str] = {}
    for text in given:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            lacks = "key" if equals else "value"
            raise ConfigError(f"--set {text}: has no {lacks}; write KEY=VALUE, for example --set R.winding=9")
        pairs[key.strip()] = value.strip()
    if estimator is not None:
        pairs["estimator"] = estimator
    if tuning is not None:
        pairs["tuning"] = tuning
    return pairs


def check_numbers(command: type, words: Sequence[str]) -> None:
    """Refuse what is no number where an option takes one; tyro would tell what Python said of it, in a frame.

    Raises:
        ConfigError: With the option and the value.
    """
    hints = get_type_hints(command)
    for word, after in zip(words, [*words[1:], ""], strict=False):
        option, equals, given = word.partition("=")
        value = given if equals else after
        hint = hints.get(option.removeprefix("--").replace("-", "_")) if option.startswith("--") else None
        number = next((kind for kind in (hint, *get_args(hint)) if kind in (int, float)), None)
        if number is None or value in ("", "None") or value.startswith("--"):
            continue
        try:
            number(value)
        except ValueError:
            what = "a whole number" if number is int else "a number"
            raise ConfigError(f"{option} {quoted(value)}: must be {what}") from None
