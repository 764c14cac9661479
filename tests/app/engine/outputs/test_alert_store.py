"""Open alerts are kept over a restart: the same id, told once, repeated when it is due, and resolved in the end."""

import json
import signal
import zlib

import pytest

from app.engine.notices import Notices
from app.engine.outputs import alert_store
from app.engine.outputs.alert_store import AlertStore
from app.engine.outputs.alerts import SETTLE_S
from app.engine.outputs.receivers import Deliveries
from app.engine.store import Store
from app.twin.secrets import NO_SECRETS
from config.output_schema import AnyReceiver
from estimators.errors import SourceError
from tests.app.engine.outputs.pushed import publishing, push
from tests.app.engine.outputs.test_alerts import Looked, Receiver, episode, started, state
from tests.app.engine.test_store import rewritten
from tests.support import run_python
from tests.waiting import LIMIT_S, wait_for

BAD = {"health": "degraded", "cause": "yoke is silent"}


def restarted(before, ago, at=0.0, make=Looked, **rule):
    """Rules of another process, `ago` seconds after those before were kept; its clock begins anywhere."""
    after = make(**rule)
    after.now = at
    after.rules.restore(json.loads(json.dumps(before.rules.state())), ago)
    return after


def test_an_open_alert_is_repeated_when_it_is_due_and_resolved_after_a_restart():
    rule = {"health": "suspect", "after": 2.0, "repeat": 60.0, "clear": 5.0}
    before = Looked(**rule)
    assert before.at(0.0, **BAD) == [] and not before.rules.state()
    (first,) = before.messages(3.0, **BAD)
    before.now = 13.0
    after = restarted(before, 20.0, **rule, at=1000.0)  # 30 s after the first message
    (known,) = after.rules.open
    assert (known.id, known.since, known.finding.text) == (first.id, first.since, "degraded: yoke is silent")
    assert after.at(1000.2, **BAD) == after.at(1029.9, **BAD) == []
    (again,) = after.messages(1030.0, **BAD)
    assert (again.status, again.id, again.since) == ("repeated", first.id, first.since)
    (last,) = restarted(after, 0.0, **rule).messages(SETTLE_S + 5.0)
    assert (last.status, last.id) == ("resolved", first.id) and last.text == "no longer: degraded: yoke is silent"
    # After hours without a process it is repeated at once.
    assert restarted(after, 7200.0, **rule).at(0.2, **BAD) == ["repeated"]


def test_nothing_is_resolved_before_the_estimate_is_known_again():
    """The filter may be compiled for minutes, and episodes are sought in the rows that are folded again."""
    rule = {"health": "suspect", "after": 0.0, "clear": 0.0}
    before = Looked(**rule)
    assert before.at(0.0, **BAD) == ["firing"]
    after = restarted(before, 0.0, **rule)
    assert after.at(0.2, health="waiting") == after.at(300.0, health="waiting") == []
    assert after.at(309.9) == after.at(310.0, **BAD) == [] and after.at(310.2) == ["resolved"]
    lost = Looked(lost=30.0, after=0.0, clear=0.0)
    assert lost.at(0.0, age_s=31.0) == ["firing"]
    after = restarted(lost, 0.0, lost=30.0, after=0.0, clear=0.0)
    assert after.at(60.0, age_s=None, health="waiting") == after.at(69.0, age_s=0.1, health="waiting") == []
    assert after.at(70.0, age_s=0.1, health="waiting") == ["resolved"]
    # In a run, too.
    running = Looked(**rule)
    assert running.at(0.0, **BAD) == ["firing"] and running.at(9.0, health="waiting") == []
    assert running.at(18.0) == [] and running.at(19.0) == ["resolved"]


def test_the_alerts_of_episodes_and_of_rules_that_were_removed_are_resolved():
    before = Looked(episode=["stuck"], after=0.0, clear=0.0)
    before.episodes = [episode("yoke"), episode("winding", start=4.0)]
    yoke, winding = before.messages(0.0)
    after = restarted(before, 1.0, episode=["stuck"], after=0.0, clear=0.0)
    after.episodes = before.episodes[1:]
    assert after.messages(0.2) == []
    (last,) = after.messages(SETTLE_S)
    assert (last.id, last.status, last.subject) == (yoke.id, "resolved", "yoke")
    other = restarted(after, 0.0, health="suspect", after=0.0)
    assert [item.id for item in other.rules.open] == [winding.id]
    (last,) = other.messages(SETTLE_S)
    assert (last.id, last.status, last.rule) == (winding.id, "resolved", "episode")
    assert last.text == "the rule episode was removed: winding: it is stuck"


class Process:
    """Rules, receivers and store of one process; its threads are those of the test."""

    def __init__(self, folder, monkeypatch, make=Looked, dead=False, **rule):
        self.receiver = Receiver(dead)
        monkeypatch.setattr("app.engine.outputs.receivers.make_receivers", lambda *_: {"ops": self.receiver})
        self.notices = Notices(lambda: 0)
        section = AnyReceiver(type="any")
        self.deliveries = Deliveries({"ops": section}, folder, None, self.notices, NO_SECRETS)
        self.looked = make(**rule)
        self.file = Store(folder / "motor.store")
        self.store = AlertStore(self.file, self.notices)
        self.problem = self.store.open(self.looked.rules, self.deliveries)

    def look(self, t, **fields):
        self.looked.now = t
        due = self.looked.rules.evaluate(self.looked.engine, state(**fields))
        self.store.send(due)
        return self

    def deliver(self):
        self.deliveries.queues["ops"].step()
        return [(alert.status, alert.id) for alert in self.receiver.got]

    def kill(self):
        """End as a killed process does: nothing more is written."""
        self.file.close()

    def said(self):
        return [line.text for line in self.notices.since(0)]


RULE = {"health": "suspect", "after": 0.0, "clear": 0.0}


def test_an_alert_is_stored_before_it_is_sent_and_told_once(tmp_path, monkeypatch):
    first = Process(tmp_path, monkeypatch, dead=True, **RULE).look(0.0, **BAD)
    assert first.deliver() == []
    first.kill()
    # Its receiver was dead: the next process sends it. A kill before the next look sends it again, with its id.
    second = Process(tmp_path, monkeypatch, **RULE)
    ((status, number),) = second.deliver()
    assert status == "firing"
    second.kill()
    (tmp_path / "motor.store").rename(tmp_path / "motor.store.alerts")  # where earlier versions kept them
    third = Process(tmp_path, monkeypatch, **RULE)
    assert third.deliver() == [("firing", number)] and not [*tmp_path.glob("*.alerts")]
    third.look(0.2, **BAD)
    third.kill()
    # From then on it was told; the cause has gone meanwhile.
    fourth = Process(tmp_path, monkeypatch, **RULE).look(0.2)
    assert fourth.deliver() == []
    fourth.look(SETTLE_S)
    assert fourth.deliver() == [("resolved", number)]
    fourth.store.close()
    fourth.kill()
    fifth = Process(tmp_path, monkeypatch, **RULE).look(0.0).look(100.0)
    assert fifth.deliver() == [] and fifth.said() == []


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (rewritten("UPDATE parts SET crc = 1"), "is damaged; remove it, or choose another path"),
        (
            rewritten(f"UPDATE parts SET data = x'7b7d', crc = {zlib.crc32(b'{}')}"),
            "cannot be continued (KeyError); remove it",
        ),
    ],
)
def test_a_part_that_cannot_be_used_is_one_line_and_alerts_are_sent(tmp_path, monkeypatch, spoil, reason):
    path = tmp_path / "motor.store"
    Process(tmp_path, monkeypatch, **RULE).look(0.0, **BAD).kill()
    spoil(path)
    before = path.read_bytes()[100:]
    process = Process(tmp_path, monkeypatch, **RULE)
    (line,) = process.said()
    assert line.startswith(f"store {path}: {reason}") and line == process.problem and "\n" not in line
    assert line.endswith("; alerts are not kept over a restart")
    assert [status for status, _ in process.look(0.0, **BAD).deliver()] == ["firing"]
    process.store.close()
    process.kill()
    assert path.read_bytes()[100:] == before


def test_alerts_are_sent_while_the_disk_is_full(tmp_path, monkeypatch):
    monkeypatch.setattr(alert_store, "RETRY_PERIOD_S", 0.0)
    process = Process(tmp_path, monkeypatch, **RULE)
    write, full = process.file.write_blocks, [True]

    def write_or_fail(blocks):
        if full[0]:
            raise SourceError("the disk is full")
        write(blocks)

    process.file.write_blocks = write_or_fail
    full[0] = False
    process.look(0.0)
    full[0] = True
    process.look(0.2, **BAD)
    full[0] = False
    process.look(0.4, **BAD).kill()
    ((status, number),) = process.deliver()
    assert status == "firing"
    lines = [line for line in process.said() if line.startswith(("the disk", "store"))]
    assert lines == [
        "the disk is full; alerts are sent without it, and it is tried again",
        f"store {tmp_path / 'motor.store'}: it is written again",
    ]
    after = Process(tmp_path, monkeypatch, **RULE).look(SETTLE_S)
    assert after.deliver() == [("firing", number), ("resolved", number)]  # neither was known to be delivered


RUN = """
import os, signal, sys
from pathlib import Path
from app.web.running import OpenedTwin, RunningTwin
from sources.source import ignore
from tests.app.engine.outputs.test_alerts import started
from tests.waiting import wait_for

folder, first, value = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
twin = started({"log": {"type": "webhook", "url": sys.argv[4]}})
opening = OpenedTwin(twin, lambda report: twin.open_source(ignore), store=folder / "a.store")
running = RunningTwin(opening, http_server=None)
running.start()
source = running.engine.innermost
for k in range(first, first + 60):
    source.send([{"time": (1767225600 + k) * 10**9, "values": {"winding": value}}])
publisher = running.publisher
def stored():
    counts = publisher._parts.deliveries.counts()  # taken, which is stored after the next look
    return source.accepted and running.store.has(source.accepted) and counts == publisher._store._written == [(1, 0)]
wait_for(stored)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_yaml_that_is_saved_while_an_alert_is_open_does_not_begin_it_again(serve, hook, monkeypatch):
    monkeypatch.setattr("app.engine.outputs.alerts.SETTLE_S", 0.0)
    rule = "{state: temperature, above: 45, after: 0, clear: 0}"
    with publishing(serve, started({"log": hook.section}, f"[{rule}]")) as page:
        publisher = page.engine.published
        for k in range(30):
            push(page, (k, 50.0))
        wait_for(lambda: len(hook.alerts) == 1)
        first = publisher._parts
        page.engine.twin = started({"log": hook.section}, f"[{{health: stale}}, {rule}]")
        wait_for(lambda: publisher._parts is not first)
        for k in range(30, 80):
            push(page, (k, 40.0))
        wait_for(lambda: len(hook.alerts) == 2)
    assert [alert["status"] for alert in hook.alerts] == ["firing", "resolved"]
    assert hook.alerts[0]["id"] == hook.alerts[1]["id"]


def test_a_killed_process_is_followed_by_one_that_resolves_its_alert(tmp_path, hook):
    for first, value, count in (("0", "50.0", 1), ("60", "40.0", 2)):
        run_python(RUN, tmp_path, first, value, hook.url, status=-signal.SIGKILL, timeout=LIMIT_S)
        assert len(hook.alerts) == count
    told = hook.alerts
    assert [alert["status"] for alert in told] == ["firing", "resolved"]
    assert told[0]["id"] == told[1]["id"] and told[0]["since"] == told[1]["since"]
