"""Arguments of every command, a dataclass for each. Nothing slow is imported here, so that help appears at once."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

Twin = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TWIN")]
OptionalTwin = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="TWIN")]
Repeated = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


@dataclass(frozen=True)
class TwinOptions:
    """Options of a command that works on one twin."""

    twin: Twin
    """Name of a bundled twin, or path to a YAML file."""


@dataclass(frozen=True, kw_only=True)
class SettingsOption:
    """Option of a command that changes settings of a twin."""

    set: Repeated = ()
    """KEY=VALUE, repeatable; see `nisus run --help`."""


@dataclass(frozen=True, kw_only=True)
class EstimatorOption(SettingsOption):
    """Option of a command that runs one estimator."""

    estimator: str | None = None
    """Estimator to use instead of the twin's own; `nisus filters` lists them."""


@dataclass(frozen=True, kw_only=True)
class TuningOption(SettingsOption):
    """Option of a command that starts from a tuning version."""

    tuning: str | None = None
    """Name of the tuning version to start from; `nisus tunings TWIN` lists them. Default: the twin's file."""


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """Options of a command that reads the log of a twin."""

    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    duration: float | None = None
    """Read only this many seconds of the source."""


@dataclass(frozen=True, kw_only=True)
class PartOptions:
    """Options of a command that scores a part of the log; the filter still runs from the start."""

    since: str | None = None
    """Score only from here: a share of the measurements (50%), a time after the start (600, 10min), or a date
    (2024-05-01T14:00, UTC)."""
    until: str | None = None
    """Score only up to here, given as --since."""


@dataclass(frozen=True, kw_only=True)
class ClusterOption:
    """Option of a command whose folds may run on other machines."""

    cluster: str | None = None
    """Use the workers of a Dask cluster: the address of its scheduler, or local:N for N processes on this machine."""


@dataclass(frozen=True, kw_only=True)
class WorkersOption(ClusterOption):
    """Options of a command whose folds do not depend on one another."""

    jobs: int | None = None
    """Number of processes. Default: one per processor."""


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """Option of a command with a result for scripts."""

    json: Flag = False
    """Print one JSON document; its fields are in docs/reference.md."""


@dataclass(frozen=True)
class FoldOptions(LogOptions, TuningOption, EstimatorOption, TwinOptions):
    """Options of a command that folds the log of a twin."""


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Options for reading recordings."""

    dbc: Repeated = ()
    """DBC file that names messages and signals, repeatable; FILE@BUS limits it to one bus."""
    time: str | None = None
    """Time column of a table. Default: the column with such a name."""
    time_unit: str = "s"
    """Unit of the time column: s, ms, us, ns, min, h or d; excel or matlab for serial dates."""
    time_format: str | None = None
    """Format of its dates, for example "%m/%d/%Y %H:%M:%S". Default: detected."""
    time_zone: str | None = None
    """Time zone of dates without an offset, for example Europe/Berlin. Default: UTC."""
    heading: str | None = None
    """Line with the names of the columns of a table, or none. Default: detected."""
    delimiter: str | None = None
    """Sign between its cells, or tab or space. Default: detected."""
    decimal: str | None = None
    """Decimal sign of its numbers. Default: detected."""
    skip: int = 0
    """Lines before it, which are left out."""
    sheet: str | None = None
    """Sheet of a workbook, or group of a TDMS file. Default: the only one with a table."""


@dataclass(frozen=True, kw_only=True)
class RoleOptions:
    """Roles of signals in a draft: names (SIGNAL, MESSAGE.SIGNAL or a column) or globs, separated by commas."""

    sensors: str = ""
    """Signals that measure the states, for example "WHEEL_*,YAW_RATE"."""
    inputs: str = ""
    """Signals that drive the states and have no state of their own."""
    hold_out: str = ""
    """Sensors that are predicted and scored, never used."""
    signals: str = ""
    """Signals to use in the roles that the draft finds. Default, without --sensors: the six with most levels."""


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """Options of a command that opens the page."""

    port: int = 9900
    """Port of the page on 127.0.0.1; 0 picks a free one."""
    recordings: Path = Path("recordings")
    """Folder of recordings and of logs dropped on the page; created when needed."""
    no_browser: Flag = False
    """Print the URL without opening a browser."""
    tokens: Path | None = None
    """File of tokens for other programs, a line NAME ROLE TOKEN each; roles are view, feed, tune and admin."""
    public: str | None = None
    """Address at which a reverse proxy offers the page, https://HOST; needs --tokens."""
    duration: float | None = None
    """Stop after this many seconds."""


@dataclass(frozen=True, kw_only=True)
class ArchiveOptions:
    """Options of a command that archives the rows of twins."""

    archive: Path | None = None
    """Archive each row of the twin, with its estimate, in Parquet files in this folder, in a folder for each twin;
    `nisus query` reads them. A process that is killed loses the open file."""
    archive_split: str = "64MB,1h,day"
    """Complete a file of the archive at this size or duration, or at the end of a day (UTC, by the times of the
    rows)."""
    archive_keep: str | None = None
    """Remove the oldest files of a twin beyond this total size or age, or both: 20GB, 365d, or 20GB,365d."""


@dataclass(frozen=True)
class RunCommand(JsonOption, ArchiveOptions, PageOptions, TuningOption, EstimatorOption):
    """Run a twin and show it in the browser. Without a twin: the gallery of bundled twins.

    An option is also taken from the environment: NISUS_RUN_PORT=8080 is --port 8080, unless that is given.

    Examples:
      nisus run
      nisus run motor_can
      nisus run road_car --set estimator=ukf --speed 10
      nisus run motor_can --headless --record drive.rrd
    """

    from_environment = True

    twin: OptionalTwin = None
    """Name of a bundled twin (see `nisus twins`), or path to a YAML file. Default: choose one in the gallery."""
    set: Repeated = ()
    """KEY=VALUE, repeatable: Q.temperature=0.02, R.winding=9, p.NAME, use.SENSOR=false, gate, or a dotted YAML key."""
    log: tuple[Path, ...] = ()
    """Recordings to read instead of the twin's own."""
    record: Path | None = None
    """Record to this .rrd file from the start. %Y %m %d %H %M %S stand for local date and time, so that a service can
    repeat the command: run-%Y%m%d-%H%M%S.rrd."""
    store: Path | None = None
    """Keep the state of the twin in this file (in a folder: TWIN.store), and continue from it after a restart or a
    kill."""
    record_split: str | None = None
    """Continue in a new file (run-2.rrd after run.rrd) at this size or duration, or at midnight: 1GB, 10min, day;
    several are separated by commas."""
    record_keep: str | None = None
    """Remove the oldest recordings of this name beyond this total size or age: 20GB, 30d."""
    speed: float | None = None
    """Speed of replays and simulations, as a multiple of real time; inf is as fast as possible. Default: the twin's."""
    headless: Flag = False
    """Run without a page, to the end of the source, and print the counts of events (--json: as JSON)."""
    log_format: Literal["text", "json"] | None = None
    """Print the notices of the twin and errors on standard error, as lines of text or of JSON."""


@dataclass(frozen=True)
class FoldCommand(JsonOption, PartOptions, FoldOptions):
    """Fold the log of a twin as fast as possible and print scores, calibration and fault episodes.

    Examples:
      nisus fold motor_winding --duration 600
      nisus fold motor_can --log drive.blf --html report.html
      nisus fold battery_panasonic --blind --plot cell.pdf
      nisus fold motor_can --set gate.kind=soft --json
      nisus fold drive.yaml --since 50%
    """

    out: Path | None = None
    """Write the track to this .csv or .parquet file, a ROS 2 bag to this .mcap file (needs `nisus[robotics]`), or a
    recording to this .rrd file."""
    html: Path | None = None
    """Write a self-contained HTML report: scores, charts, checks, episodes, tuning."""
    plot: Path | None = None
    """Draw states with ± 2 σ and measurements, innovations and NIS into this .png, .pdf or .svg (needs
    `nisus[plot]`)."""
    blind: Flag = False
    """Ignore all true states: of a simulator, a recording or a table. Nothing is then scored against them."""
    smooth: Flag = False
    """Also smooth: estimate each state from all measurements, before and after. Adds columns to --out."""


@dataclass(frozen=True)
class WhyCommand(JsonOption, FoldOptions):
    """Tell what moved the estimate: attribute its change to the model, each input and each sensor.

    Examples:
      nisus why battery_panasonic --at 1500 --span 600
      nisus why motor_can --duration 60 --state magnet --json
    """

    at: str | None = None
    """End of the change: a time after the start (1500, 25min), a share of the measurements (50%), or a date.
    Default: the end of the log."""
    span: float | None = None
    """Its duration, s. Default: the window of the twin's view."""
    state: Repeated = ()
    """State to show, repeatable. Default: the four that moved by most standard deviations."""


@dataclass(frozen=True)
class CheckCommand(JsonOption, ClusterOption, FoldOptions):
    """Print a checklist of what could be wrong with a twin without being detected.

    Linearity, size, shape of the posterior, observability, the smallest visible fault of every sensor, input and
    parameter, protection levels, timing, health, and the prediction of every sensor held out in turn.

    Examples:
      nisus check motor_bench --duration 600
      nisus check motor_can --html check.html
    """

    html: Path | None = None
    """Also write a self-contained HTML page."""


@dataclass(frozen=True)
class AdviseCommand(JsonOption, RoleOptions, TableOptions, LogOptions, EstimatorOption):
    """Recommend an estimator for a twin from its log, or draft a twin from recordings.

    For a twin: the simplest estimator whose assumptions hold on the log, with the figure behind each claim and the
    lines for its YAML. For recordings: sample rates, gaps, noise, redundant signals, and drivers of each signal.

    Examples:
      nisus advise motor_can
      nisus advise drive.csv --sensors "wheel_*" --out drive.yaml
    """

    what: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Name of a bundled twin, path to a YAML file, or recordings."""
    apply: Flag = False
    """Write the lines into the twin's YAML; the previous file is kept beside it."""
    out: Path | None = None
    """Write the changed YAML to this file. Recordings: fit the draft, check it, and write NAME.yaml and NAME.py."""


@dataclass(frozen=True)
class CompareCommand(JsonOption, WorkersOption, PartOptions, LogOptions, TuningOption):
    """Fold every applicable filter over the same log, in parallel, and print a table of scores.

    Filters that draw random members are folded with eight seeds; their figures are mean ± standard deviation of one
    fold. A step is one event of the log; its cost is the time on one processor.

    Examples:
      nisus compare lorenz63 --duration 30
      nisus compare motor_can --estimators ekf ukf
    """

    twin: Twin
    """Name of a bundled twin, path to a YAML file, or `all` for every bundled twin."""
    estimators: tuple[str, ...] = ()
    """Compare only these filters."""
    logs: int = 1
    """Number of simulated logs, with consecutive seeds; figures are mean ± standard deviation over them."""
    budget: float = 20.0
    """CPU seconds for each filter; a slower filter folds a shorter span, shown in its row."""
    write: Flag = False
    """Save the table as CSV: config/scores/NAME.csv for a bundled twin, else NAME.scores.csv beside the YAML."""


@dataclass(frozen=True)
class TuneCommand(JsonOption, ClusterOption, PartOptions, EstimatorOption, TwinOptions):
    """Fit noises, parameters and options to recordings, and propose the result if it predicts held-out data better.

    Each recording is divided into blocks of time, and every third is held out to judge the fit. So are each sensor in
    turn and the true states where they are known. Exit status: 0 if a tuning is proposed, 1 if not.

    Examples:
      nisus tune motor_bench --fit Q,R --keep fitted
      nisus tune pump.yaml --apply
      nisus tune motor_winding --fit scale --duration 300
    """

    fit: str = "Q,R"
    """What to fit, separated by commas: groups (Q, R, p, options, prior; over: correlation times) and single entries
    (Q.winding, R.yoke, p.NAME, options.alpha, prior.STATE.std). scale: one factor for all of Q and R."""
    aim: Literal["witnesses", "likelihood", "crps", "error"] | None = None
    """Objective. likelihood: of every measurement given those before it. witnesses: likelihood plus true states and
    held-out sensors. crps, error: predictions of sensors held out in turn, by continuous ranked probability score or
    squared error. Default: witnesses for recordings, likelihood for simulations."""
    predict: tuple[str, ...] = ()
    """Sensors that crps and error hold out. Default: each in turn."""
    set: Repeated = ()
    """KEY=VALUE, repeatable; see `nisus run --help`. Sets the start of the fit, which is also its weak prior."""
    log: Repeated = ()
    """Recording to fit instead of the twin's own, repeatable. FILE,FILE are parts of one recording; FILE@0.5 has half
    the weight."""
    logs: int = 1
    """Number of simulated logs, with consecutive seeds."""
    duration: float | None = None
    """Read only this many seconds of each recording."""
    since: str | None = None
    """Fit only from here: a share of the measurements (50%), a time after the start (600, 10min), or a date
    (2024-05-01T14:00, UTC). The filter still runs from the start."""
    until: str | None = None
    """Fit only up to here, given as --since."""
    blocks: int | None = None
    """Number of blocks with equally many measurements; every third is held out. 0 fits all of them and judges nothing.
    Default: 9, with --belief none 0."""
    belief: Literal["weak", "none"] = "weak"
    """Prior about the values of the twin. weak: a factor of 10 in a standard deviation; entries that the data do
    not determine keep their values. none: plain maximum likelihood of every entry."""
    windows: str | None = None
    """Dual estimation: fit one window of this length after another (600, 10min, 1h), as a running twin with `refit`
    does, and print every parameter over time. A shorter log is one window."""
    every: str | None = None
    """Time between the ends of two windows. Default: the length of the windows."""
    apply: Flag = False
    """Write the proposed values into the twin's YAML; comments stay, and the previous file is kept beside it."""
    out: Path | None = None
    """Write a copy of the twin's YAML with the proposed values to this file."""
    save: Path | None = None
    """Write the proposed tuning to this .yaml file, as sections that replace the twin's own."""
    keep: str | None = None
    """Save the proposed tuning as a tuning version of this name; see `nisus tunings`."""
    note: str = ""
    """Note to save with --keep."""


@dataclass(frozen=True)
class CommissionCommand(JsonOption, FoldOptions):
    """Record the normal innovations of a twin from fault-free data; later alarms then report changes from it.

    Prints the section `baseline`, or writes it to NAME.baseline.yaml beside the twin's NAME.yaml.

    Examples:
      nisus commission motor_bench --duration 1800
      nisus commission pump.yaml --write
    """

    force: Flag = False
    """Accept a log that its own detectors or calibration contradict; the baseline keeps the reason as a mark."""
    write: Flag = False
    """Write the section to NAME.baseline.yaml, or where the twin has one; it replaces that."""


@dataclass(frozen=True)
class FiltersCommand(JsonOption):
    """List the estimators: assumptions, options, cost, and when they fail.

    Examples:
      nisus filters
      nisus filters ukf
      nisus filters --twin motor_can
    """

    name: Annotated[str | None, tyro.conf.Positional] = None
    """Name of an estimator, which is described alone, or of a twin, as --twin."""
    twin: str | None = None
    """Name of a bundled twin, or path to a YAML file: list which filters apply, their cost, and why others do not."""


@dataclass(frozen=True)
class ReviewCommand(PageOptions):
    """Open a recording on the page, where its measurements can be folded again with other settings.

    Examples:
      nisus review drive.rrd
    """

    file: Annotated[Path, tyro.conf.Positional]
    """The .rrd file."""


@dataclass(frozen=True)
class TwinsCommand(JsonOption):
    """List the bundled twins, or describe one with the scores of every filter.

    Examples:
      nisus twins
      nisus twins motor_can
    """

    name: OptionalTwin = None
    """Name of a bundled twin, or path to a YAML file."""
    picture: Flag = False
    """Draw the gallery picture of the twin, or of all: config/cards/NAME.svg, or NAME.svg beside the YAML."""


@dataclass(frozen=True)
class TuningsCommand(JsonOption, FoldOptions):
    """List the tuning versions of a twin, compare two of them, save one or accept one.

    Versions are files FILE.tunings/NAME.yaml beside FILE.yaml; those of a bundled twin are in the user's data folder.
    `own` is the twin's file itself. --estimator, --set, --tuning, --log and --duration are for --save.

    Examples:
      nisus tunings motor_bench
      nisus tunings motor_bench --save soft --set gate.kind=soft
      nisus tunings motor_bench own soft
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Two versions to compare: the entries that differ, and their scores."""
    save: str | None = None
    """Save the twin with --tuning, --estimator and --set as a version of this name, with its scores."""
    accept: str | None = None
    """Accept the version of this name: `nisus guard` then folds with it."""
    apply: str | None = None
    """Write the values of the version of this name into the twin's YAML; the previous file is kept beside it."""
    note: str = ""
    """Note for --save and --accept."""


@dataclass(frozen=True)
class SchemaCommand:
    """Write the JSON Schema of a twin's YAML, for editors that complete and check.

    Examples:
      nisus schema --out twin.schema.json
    """

    out: Path | None = None
    """File to write. Default: standard output."""


@dataclass(frozen=True)
class LogCommand(JsonOption, TableOptions):
    """List the content of recordings: buses, messages, signals or columns, with rates, time spans and gaps.

    Examples:
      nisus log drive.blf --dbc car.dbc
      nisus log plant.csv --time Time --time-zone Europe/Berlin
    """

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """CAN logs (MF4, BLF, ASC, TRC, candump, CSV, SQLite) or tables (CSV, Parquet, Arrow, MATLAB, NumPy), in order; or
    a folder or ZIP archive of these."""


@dataclass(frozen=True)
class NewCommand(JsonOption, RoleOptions, TableOptions):
    """Write NAME.yaml and NAME.py, a runnable example (a pump) or a draft from the signals of a recording.

    A draft is fitted to the first half of the recording and checked on the second. Ctrl-C keeps what has been fitted.

    Examples:
      nisus new pump
      nisus new drive --log drive.csv --sensors "wheel_*,yaw_rate" --inputs torque --hold-out wheel_rr
    """

    name: Annotated[str, tyro.conf.Positional]
    """Name of the twin."""
    folder: Path = field(default_factory=Path.cwd)
    """Folder to write to."""
    log: tuple[Path, ...] = ()
    """Recordings whose signals become sensors."""


@dataclass(frozen=True)
class MigrateCommand(JsonOption):
    """Rewrite twins, fleets and tuning versions by the names of this version; comments stay.

    Of a twin its tuning versions too. The file as it was is kept beside it, as FILE.yaml.1.bak.

    Examples:
      nisus migrate drive.yaml
      nisus migrate plant/*.yaml
    """

    files: Annotated[tuple[str, ...], tyro.conf.Positional]
    """YAML files."""


COMMANDS: dict[type, str] = {
    RunCommand: "run:run_twin",
    FoldCommand: "fold:fold_twin",
    WhyCommand: "why:explain_change",
    CheckCommand: "check:check_twin",
    AdviseCommand: "advise:advise",
    CompareCommand: "compare:compare_twin",
    TuneCommand: "tune:tune_twin",
    CommissionCommand: "commission:commission_twin",
    FiltersCommand: "filters:show_filters",
    ReviewCommand: "run:review_recording",
    TwinsCommand: "twins:show_twins",
    TuningsCommand: "tunings:tunings_of",
    MigrateCommand: "migrate:migrate",
    SchemaCommand: "new:write_schema",
    LogCommand: "log:show_log",
    NewCommand: "new:new_twin",
}
"""Module and function of every command, imported when the command runs."""

NAMES = {command.__name__.removesuffix("Command").lower(): command for command in COMMANDS}  # as on the command line
