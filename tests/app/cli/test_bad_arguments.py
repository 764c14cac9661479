"""What a command refuses: one line with the option or subject, its value and a remedy, before any long work."""

import shlex

import pytest

from estimators.registry import ESTIMATORS

BUS = "bus motor_can"
RECORD = f"{BUS} --interface virtual --record"
TUNE = "tune motor_winding"
NOT_LONG = "'5s': must be a number"

REFUSED = {
    f"{BUS} --duration 0": "--duration 0: must be positive",
    f"{BUS} --interface virtual": "stay in this process; use udp_multicast, or give --record",
    f"{BUS} --interface socketcan": "needs a channel; give --channel, for example can0",
    f"{BUS} --interface no_such_bus --channel x": "CAN bus no_such_bus:x: it cannot be opened",
    "bus motor_winding": "source is of type simulator",
    f"{RECORD} drive.txt": "--record drive.txt: is not a CAN log format",
    f"{RECORD} drive.db": "end it in .asc, .blf, .csv, .log, .mf4, .trc",
    f"{RECORD} no/drive.blf": "there is no folder no; create it first",
    "compare motor_can --estimators kf": "does not apply",
    "compare motor_winding --write --estimators kf": "leave other options out",
    "compare motor_winding --logs 0": "--logs 0",
    # `nisus run` has --speed, which is nearer.
    "compare motor_can --seeds 2": "'--seeds': `nisus compare` has no such option; did you mean --set?",
    "compare motor_can --logs 2": "is not simulated",
    "fold lorenz63 --set =3": "--set =3: has no key; write KEY=VALUE",
    "fold lorenz63 --set gate": "--set gate: has no value; write KEY=VALUE",
    "fold lorenz63 --set estimator=zzz": f"'zzz' does not exist; choose from {', '.join(ESTIMATORS)}",
    "fold lorenz63 --set zzz=1": "zzz is not a tuning key of lorenz63; choose from ",
    "fold lorenz63 --set p.sgma=1": "did you mean p.sigma",
    "fold lorenz63 --out track.txt": "--out track.txt: must end in .csv, .parquet, .mcap or .rrd",
    "fold motor_can --set gate.kind=sft": "gate.kind is 'sft'; it must be 'hard' or 'soft'",
    "fold motor_can --set gate.knd=soft": "gate.knd is not known; did you mean kind?",
    "fold lorenz63 --duratoin 3": "'--duratoin': `nisus fold` has no such option; did you mean --duration?",
    "fold lorenz63 --log a.csv --log b.csv": "--log: is given twice, of which only the last would count; name all",
    "fold lorenz36": "lorenz36: no twin of that name ships; did you mean lorenz96 or lorenz63",
    "fold lorenz63 --estimator ufk": "estimator 'ufk' does not exist; did you mean ukf?",
    "compare lorenz63 --estimators ufk": "estimator 'ufk' does not exist; did you mean ukf?",
    "fold lorenz63 --tuning ow": "did you mean own; see",
    "fld lorenz63": "fld: there is no such command; did you mean fold",
    "--versoin": "--versoin: there is no such option; did you mean --version?",
    "run motor_can --json": "--json: is the result of a run without a page; give --headless",
    "run motor_can --public https://a.example": "--public https://a.example: others can reach it; give --tokens FILE",
    **{
        f"run motor_can --tokens t --public {site}": f"--public {site}: must be like https://twins.example.com, in"
        for site in ("https://A.example", "https://a.example:443", "http://a.example:80", "https://a.example/b")
    },
    **{
        f"serve motor_can --tokens t --public '{site}'": f"--public {site}: must be like https://twins.example.com"
        for site in ("https://u:p@a.example", "https://a.example#b", "https://a .example", "https://a.example:65536")
    },
    "run motor_can --port abc": "--port 'abc': must be a whole number",
    "run motor_can --port=9e3": "--port '9e3': must be a whole number",
    "run motor_can --duration 5s": f"--duration {NOT_LONG}",
    "run --no-browser --headless": "run: the twin is missing; name one",
    "run --no-browser --record x.rrd": "run: the twin is missing; name one",
    "run --no-browser --log x.csv": "run: the twin is missing; name one",
    "run --no-browser --set R.winding=9": "run: the twin is missing; name one",
    "run --no-browser --estimator ukf": "run: the twin is missing; name one",
    "stress motor_winding --only earthquake": "--only earthquake: no mistake has that in its name; see --list",
    "stress motor_winding --seeds 0": "--seeds 0: must be 1 or more",
    "stress motor_winding --duration -3": "--duration -3: must be positive",
    f"{TUNE} --fit R.wnding": "R.wnding is no entry that can be fitted; did you mean R.winding",
    f"{TUNE} --fit ,": "--fit names nothing; write for example --fit Q,R",
    f"{TUNE} --blocks 2": "--blocks 2: must be 3 or more",
    f"{TUNE} --predict winding": "--predict: is for --aim crps and --aim error",
    f"{TUNE} --duration -1": "--duration -1: must be positive",
    f"{TUNE} --save found.txt": "--save found.txt: must end in .yaml",
    f"{TUNE} --save nowhere/found.yaml": "--save nowhere/found.yaml: there is no folder nowhere; create it first",
    f"{TUNE} --logs 0": "--logs 0: must be 1 or more",
    f"{TUNE} --aim crps": "the aim is crps; it needs a sensor to hold out, and another one that is used",
    f"{TUNE} --set 'sensors.winding={{std: {{value: 2, from: 3}}}}'": "sensors.winding.std.value is 2; it must lie",
    f"{TUNE} --keep ../x": "the version's name is",
    f"{TUNE} --windows soon": "--windows soon: give seconds, or a number with its unit, as in 10min",
    f"{TUNE} --windows 0": "--windows 0: must be positive",
    f"{TUNE} --windows 60 --every -1": "--every -1: must be positive",
    f"{TUNE} --every 60": "--every: is the time between the ends of two --windows; give both",
    f"{TUNE} --windows 60 --aim crps": "--aim crps: cannot be used with --windows, which are fitted by likelihood",
    f"{TUNE} --windows 60 --fit R.wnding": "R.wnding is no entry that can be fitted; did you mean R.winding",
    f"{TUNE} --fit p.nosuch": "p.nosuch is no entry that can be fitted; motor_winding has none of p; choose from Q.",
    "tune motor_bench --fit p.nosuch": "p.nosuch is no entry that can be fitted; choose from p.",
    f"{TUNE} --since 50% --windows 60": "--since and --until: cannot be used with --windows",
    f"{TUNE} --log a.csv --log a.csv": "--log a.csv: is given twice; name each recording once",
    "advise motor_winding --dbc car.dbc": "--hold-out are for recordings",
    "advise motor_winding motor_can": "one twin at a time",
    "guard motor_winding --junit nowhere/a.xml": "there is no folder",
    "guard motor_winding --junit .": "is a folder; name a file in it",
    "guard motor_winding --jobs 0": "--jobs 0: must be 1 or more",
    "guard motor_winding --jobs -3": "--jobs -3: must be 1 or more",
    "guard motor_winding --accept": "--accept: give the reason with --note TEXT",
    "guard nobody": "nobody",
    "new pump --signals Temp": "--hold-out and --dbc are for recordings; name one with --log FILE",
    "twins lorenz": "no twin of that name ships",
}


@pytest.mark.parametrize("command", REFUSED)
def test_a_wrong_argument_is_one_line(command, nisus, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("app.studies.guard.guard_log", lambda *_: pytest.fail("it was folded"))
    assert REFUSED[command] in nisus.refuses(*shlex.split(command))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("more", ["", "--windows 60"])
def test_an_unknown_entry_is_refused_before_anything_is_compiled(more, nisus, monkeypatch):
    monkeypatch.setattr("app.cli.tune.prepare", lambda twin: pytest.fail("it was compiled"))
    assert "p.nosuch is no entry" in nisus.refuses("tune", "motor_bench", "--fit", "p.nosuch", *more.split())
