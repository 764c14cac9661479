"""Notes of users at moments of the log: added, changed and deleted by commands, kept when the log begins again."""

import pytest

from app.engine.commands import Annotate, DeleteAnnotation
from app.engine.execute import prepared
from app.engine.notices import MAX_ANNOTATIONS, Annotation, Annotations
from estimators.errors import ConfigError
from tests.app.scripted import Replayed, Stepped, readings
from tests.support import SECOND


@pytest.fixture
def noted():
    """A twin with measurements at 1 to 10 s and two notes, the second of which is earlier."""
    stepped = Stepped(source=Replayed()).put(readings(range(1, 11), [40.0] * 10))
    stepped.submit(Annotate("  pump\n off "), Annotate("door open", at=2.5))
    return stepped


def test_notes_are_added_changed_and_deleted(noted):
    notes = lambda: noted.engine.annotations.notes  # noqa: E731
    at = round(2.5 * SECOND)
    assert notes() == (Annotation(2, at, "door open"), Annotation(1, 10 * SECOND, "pump off"))
    noted.submit(Annotate("door closed", number=2), Annotate("pump on", at=4.0, number=1))
    assert notes() == (Annotation(2, at, "door closed"), Annotation(1, 4 * SECOND, "pump on"))
    noted.submit(DeleteAnnotation(2), Annotate("another", at=1.0))
    assert notes() == (Annotation(3, SECOND, "another"), Annotation(1, 4 * SECOND, "pump on"))


def test_notes_stay_when_the_log_begins_again(noted):
    before = noted.engine.annotations.notes
    noted.source.restart()
    noted.put(readings([1.0, 2.0], [40.0, 40.0]))
    assert noted.engine.span()[1] == 2 * SECOND and noted.engine.annotations.notes == before
    # Its moment is yet to come again; the text can be changed.
    noted.submit(Annotate("pump back on", number=1))
    assert noted.engine.annotations.find(1) == Annotation(1, 10 * SECOND, "pump back on")


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (Annotate(" \n"), r"^Annotate: text is ' \\n', of 0 characters; write 1 to 500$"),
        (Annotate("x" * 501), r"^Annotate: text is 'x+\.\.\.', of 501 characters; write 1 to 500$"),
        (Annotate("x", at=10.1), r"^Annotate: at is 10\.1 s; it must lie within the log, 1 to 10 s \(times as in "),
        (Annotate("x", at=0.9), r"^Annotate: at is 0\.9 s; it must lie within the log"),
        (Annotate("x", number=7), r"^there is no note 7; /api/annotations lists those there are$"),
        (DeleteAnnotation(7), r"^there is no note 7;"),
    ],
)
def test_a_note_that_cannot_be_is_refused_with_the_reason(noted, command, reason):
    before = noted.engine.annotations.notes
    with pytest.raises(ConfigError, match=reason):
        noted.submit(command)
    assert noted.engine.annotations.notes == before


def test_before_the_first_measurement_there_is_no_moment():
    with pytest.raises(ConfigError, match=r"^Annotate: no measurement has arrived yet; wait for the first$"):
        prepared(Annotate("x"), Stepped().engine)


def test_the_number_of_notes_is_bounded():
    kept = Annotations()
    kept.restore(Annotation(k, k, "x") for k in range(MAX_ANNOTATIONS))
    with pytest.raises(ConfigError, match=r"^Annotate: there are 1000 notes; delete one first$"):
        kept.check("x", None, None, (0, 1))
    kept.check("y", None, 5, (0, 1))
