"""Bookkeeping of revisions: what is kept of which, and what is said of it."""

from types import SimpleNamespace

import pytest

from app.engine.revisions import MAX_PINNED, Revisions
from app.twin.changes import difference, in_words
from app.twin.twin import load_twin
from estimators.errors import ConfigError
from estimators.models import MODELS
from estimators.registry import ESTIMATORS
from estimators.tuning import Tuning

FIRST = Tuning.of(MODELS["motor_winding"])


class Told:
    """Revisions as an engine tells them, on a clock that a test turns."""

    def __init__(self):
        self.now = 0.0
        self.revisions = Revisions("kf", FIRST, clock=lambda: self.now)
        self.number = 0

    def edit(self, estimator="kf", after=10.0, gesture="", **fields):
        key, value = next(iter(fields.items()), (None, None))
        tuning = self.runs[-1].tuning if key is None else self.runs[-1].tuning.set(key.replace("_", "."), value)
        return self.become(estimator, tuning.with_options({}) if key is None else tuning, after, gesture)

    def become(self, estimator, tuning, after=10.0, gesture=""):
        self.now += after
        track = SimpleNamespace(revision=self.number)
        self.revisions.left(track, estimator, tuning, gesture)
        self.number += 1
        return track

    @property
    def runs(self):
        return self.revisions.runs

    @property
    def numbers(self):
        return [run.number for run in self.runs]

    @property
    def kept(self):
        return [run.number for run in self.runs if run.track is not None]


@pytest.fixture
def told():
    return Told()


def test_only_the_newest_previous_track_is_kept(told):
    tracks = [told.edit(Q_rate=value) for value in (0.1, 0.2, 0.3)]
    assert told.numbers == [0, 1, 2, 3] and told.kept == [2]
    assert told.revisions.previous() is tracks[-1]
    assert [run.began for run in told.runs] == [0.0, 10.0, 20.0, 30.0]


def test_what_changed_is_said_in_words(told):
    told.edit(Q_rate=0.25)
    told.edit("ukf")
    told.edit("ukf", gate=0.99)
    told.edit("ukf", use_winding=False)
    said = [in_words(run.changes) for run in told.runs[1:]]
    assert said == [f"Q.rate {FIRST.get('Q.rate'):.6g} → 0.25", "kf → ukf", "gate off → 0.99", "winding held out"]


@pytest.mark.parametrize("after", [0.1, 60.0])
def test_a_drag_is_one_revision_against_what_was_before_it(told, after):
    before = told.edit(R_winding=2.0)
    first = told.edit(Q_rate=0.1, gesture="drag")
    # However slow the folds are, and though it passes where it began.
    for value in (0.2, FIRST.get("Q.rate"), 0.4):
        told.edit(Q_rate=value, after=after, gesture="drag")
    assert told.numbers == [0, 1, 5]
    (change,) = told.runs[-1].changes
    assert (change.key, change.before, change.after) == ("Q.rate", FIRST.get("Q.rate"), 0.4)
    assert told.revisions.previous() is first is not before
    assert told.kept == [1]


@pytest.mark.parametrize("gestures", [("", ""), ("one", "another"), ("one", "")])
def test_edits_of_different_gestures_are_runs_of_their_own(told, gestures):
    for gesture, value in zip(gestures, (0.1, 0.2), strict=True):
        told.edit(Q_rate=value, after=0.0, gesture=gesture)
    assert told.numbers == [0, 1, 2]


def test_the_first_run_outlasts_all_others(told, monkeypatch):
    monkeypatch.setattr("app.engine.revisions.MAX_REVISIONS", 4)
    for value in (0.1, 0.2, 0.3, 0.4, 0.5):
        told.edit(Q_rate=value)
    assert told.numbers == [0, 3, 4, 5] and [run.first for run in told.runs] == [True, False, False, False]
    told.become(told.runs[0].estimator, told.runs[0].tuning)
    assert told.numbers == [3, 4, 5, 6] and told.runs[-1].first


def test_edits_are_taken_back_and_made_again(told):
    edits, values = told.revisions.edits, [("kf", FIRST.set("Q.rate", value)) for value in (0.1, 0.2, 0.3, 0.4)]
    with pytest.raises(ConfigError, match="Undo: there is no edit to take back"):
        edits.next(again=False)
    edits.add(("kf", FIRST), values[0])
    for before, after in zip(values, values[1:3], strict=False):
        edits.add(before, after, "drag")
    assert edits.done[-1].words == "Q.rate 0.1 → 0.3 °C²/s³"
    assert edits.step(again=False) is values[0] and edits.step(again=True) is values[2]
    assert [edits.step(again=False) for _ in range(2)] == [values[0], ("kf", FIRST)]
    edits.add(("kf", FIRST), values[3])
    with pytest.raises(ConfigError, match="Redo: no edit was taken back"):
        edits.step(again=True)


def test_what_is_pinned_or_named_outlasts_a_drag_and_all_others(told):
    told.edit(Q_rate=0.1, gesture="drag")
    told.revisions.pin(1)
    track = told.edit(Q_rate=0.2, gesture="drag")
    told.revisions.describe(2, "  slow ", "why\nnot ")
    told.edit(Q_rate=0.3, gesture="drag")
    told.edit(Q_rate=0.4)
    assert told.numbers == [0, 1, 2, 3, 4] and told.kept == [1, 3]
    assert told.runs[1].track is track and told.runs[1].pinned
    assert (told.runs[2].name, told.runs[2].note) == ("slow", "why\nnot")
    told.revisions.unpin(1)
    assert told.kept == [3]


def test_four_can_be_pinned_and_their_places_stay(told):
    for k in range(MAX_PINNED):
        told.revisions.pin(k)
        told.edit(Q_rate=0.1 * (k + 1))
    with pytest.raises(ConfigError, match=r"run 4 cannot be pinned: 4 are \(0, 1, 2, 3\); unpin one first"):
        told.revisions.pin(4)
    told.revisions.unpin(1)
    told.revisions.pin(4)
    assert {run.number: run.place for run in told.runs if run.pinned} == {0: 0, 2: 2, 3: 3, 4: 1}
    told.revisions.pin(2)
    assert told.runs[2].place == 2


def test_what_is_not_known_cannot_be_pinned(told):
    with pytest.raises(ConfigError, match="run 7 is not known"):
        told.revisions.unpin(7)
    with pytest.raises(ConfigError, match="its name has 61 characters; it may have 60"):
        told.revisions.describe(0, "n" * 61, "")


def test_a_and_b_stay_two_however_often_they_are_exchanged(told):
    told.revisions.describe(0, "A", "")
    told.edit(Q_rate=0.1)
    for _ in range(5):
        last = told.runs[-2]
        told.become(last.estimator, last.tuning)
    assert len(told.runs) == 2 and told.numbers == [5, 6]
    assert {run.name for run in told.runs} == {"A", ""}
    assert told.runs[-1].loaded == 4
    assert told.runs[-1].changes[0].key == "Q.rate"


def test_a_pinned_run_that_is_loaded_stays_pinned_beside(told):
    told.revisions.pin(0)
    told.edit(Q_rate=0.1)
    for _ in range(4):
        last = told.runs[-2]
        told.become(last.estimator, last.tuning)
    assert told.runs[0].number == 0 and told.runs[0].pinned and len(told.runs) == 3


def test_a_log_that_begins_again_ends_what_can_be_compared(told):
    told.edit(Q_rate=0.1)
    told.edit(Q_rate=0.2)
    told.revisions.restarted(3)
    assert told.numbers == [0, 1, 3] and told.kept == [] and told.revisions.previous() is None
    assert told.runs[-1].changes[0].after == 0.2


def test_readers_know_when_to_look_again(told):
    seen = [told.revisions.version]
    for act in (
        lambda: told.edit(Q_rate=0.1),
        lambda: told.revisions.pin(0),
        lambda: told.revisions.describe(1, "a", ""),
    ):
        act()
        seen.append(told.revisions.version)
    assert seen == sorted(set(seen))


def test_many_rows_are_one_entry_and_options_are_compared_whole():
    model = load_twin("thermal_field").model
    tuning = Tuning.of(model)
    sensor = model.sensor_names[0]
    (change,) = difference("enkf", tuning, "enkf", tuning.set(f"R.{sensor}", 4.0))
    assert (change.key, change.after) == (f"R.{sensor}", 4.0)
    rows = difference("enkf", tuning, "enkf", tuning.set(f"R.{model.row_names[3]}", 4.0))
    assert len(rows) == 1
    members = ESTIMATORS["enkf"].complete({})["members"]
    (option,) = difference("enkf", tuning, "enkf", tuning.with_options({"members": members + 1}))
    assert (option.key, option.before, option.after) == ("options.members", members, members + 1)
