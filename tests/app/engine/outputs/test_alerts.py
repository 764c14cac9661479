"""Alerts: when each rule fires, repeats and resolves, and that every receiver gets it whatever the others do."""

import hashlib
import hmac
import sys
from types import SimpleNamespace

import pytest
from scipy.stats import norm

from app.engine.copies import AlertMute
from app.engine.outputs.alerts import AlertRules, heartbeat
from app.engine.outputs.publisher import Publisher
from app.engine.outputs.receivers import MAX_WAITING_ALERTS, Delivery
from app.engine.outputs.state_message import PublishedState, StateMessage
from app.twin.twin import load_twin
from config.output_schema import AlertSection
from estimators.diagnostics.episodes import Episode
from estimators.errors import ConfigError
from tests.app.engine.outputs.pushed import publishing, push, pushed_twin
from tests.app.scripted import notice_texts
from tests.cases import cases
from tests.support import error_of
from tests.waiting import wait_for


def state(value=100.0, std=10.0, grade="", **fields):
    """A message of one state."""
    given = {"name": "winding", "unit": "°C", "protection_level": None, "valid": value is not None}
    given |= {
        "value": value,
        "std": None if value is None else std,
        "grade": grade or ("tracking" if value else "stale"),
    }
    one = PublishedState(**given, reason="" if given["grade"] == "tracking" else "as it is")
    known = dict(twin="motor", estimator="kf", time_ns=1, time=None, sent="", age_s=0.1, revision=0, tuning=None)
    known |= dict(model_version=1, health="tracking", cause="", estimate_valid=True, inputs_valid=True, nis=1.0)
    known |= dict(states=(one,), inputs=(), sensors=(), covariance=None, covariance_of=None)
    return StateMessage(**known | fields)


def episode(subject, cause="stuck", start=3.0, end=None):
    return Episode(start, end, subject, cause, 1.0, 0.5, 1.5, "σ", f"{subject}: it is {cause}")


class Looked:
    """Rules with a clock of their own; `at(t, ...)` returns (status, text) of the messages that are due then."""

    def __init__(self, **rule):
        self.now = 0.0
        self.engine = SimpleNamespace(mute=None, episodes=lambda: self.episodes)
        self.episodes = []
        self.rules = AlertRules([AlertSection(**rule)], link="http://127.0.0.1:9900", clock=lambda: self.now)

    def messages(self, t, **fields):
        self.now = t
        return [alert for _, alert in self.rules.evaluate(self.engine, state(**fields))]

    def at(self, t, **fields):
        return [alert.status for alert in self.messages(t, **fields)]


def test_an_alert_fires_after_its_time_repeats_and_is_resolved_once():
    rules = Looked(health="suspect", after=2.0, repeat=60.0, clear=5.0)
    bad = {"health": "degraded", "cause": "yoke is silent"}
    assert rules.at(0.0) == rules.at(1.0, **bad) == rules.at(2.9, **bad) == []
    (first,) = rules.messages(3.0, **bad)
    assert (first.status, first.text, first.rule) == ("firing", "degraded: yoke is silent", "health-suspect")
    assert rules.at(10.0, **bad) == rules.at(62.9, **bad) == []
    (again,) = rules.messages(63.0, **bad)
    assert (again.status, again.id, again.since) == ("repeated", first.id, first.since)
    # A gap that is shorter than `clear` is the same alert.
    assert rules.at(64.0) == rules.at(66.0, **bad) == rules.at(70.9) == []
    (last,) = rules.messages(71.0)
    assert (last.status, last.id) == ("resolved", first.id)
    assert rules.at(80.0) == [] and not rules.rules.open
    rules.at(90.0, **bad)
    (other,) = rules.messages(92.0, **bad)
    assert other.status == "firing" and other.id != first.id


@pytest.mark.parametrize(
    ("rule", "over"),
    [({"above": 120.0}, lambda value, std: norm.sf(120.0, value, std)),
     ({"below": 80.0}, lambda value, std: norm.cdf(80.0, value, std))],
)  # fmt: skip
@pytest.mark.parametrize("probability", [0.05, 0.5, 0.95])
def test_a_limit_counts_with_its_probability(rule, over, probability):
    for value in (60.0, 79.0, 81.0, 95.0, 105.0, 119.0, 121.0, 150.0):
        rules = Looked(state="winding", probability=probability, after=0.0, **rule)
        found = rules.messages(0.0, value=value)
        assert bool(found) == (over(value, 10.0) >= probability)
        for alert in found:
            assert alert.probability == pytest.approx(over(value, 10.0), rel=1e-12)
            assert (alert.value, alert.std, alert.unit, alert.subject) == (value, 10.0, "°C", "winding")
    assert Looked(state="winding", **rule).at(0.0, value=None) == []


def test_each_episode_is_an_alert_of_its_own():
    rules = Looked(episode=["stuck"], after=0.0, clear=0.0)
    rules.episodes = [episode("yoke"), episode("winding"), episode("tooth", "shifted"), episode("magnet", end=4.0)]
    first = rules.messages(0.0)
    assert [alert.subject for alert in first] == ["yoke", "winding"] and len({alert.id for alert in first}) == 2
    assert {alert.guide for alert in first} == {"docs/alarms.md#stuck"}
    assert {alert.link for alert in first} == {"http://127.0.0.1:9900/alarms#stuck"}
    assert all("sensor" in alert.response for alert in first)
    rules.episodes = rules.episodes[:1]
    assert [(alert.status, alert.subject) for alert in rules.messages(1.0)] == [("resolved", "winding")]


@pytest.mark.parametrize(
    ("rule", "fields"), [({"nis": 2.0}, {"nis": 2.1}), ({"lost": 30.0}, {"age_s": 31.0, "health": "stale"})]
)
def test_nis_and_loss(rule, fields):
    rules = Looked(**rule, after=0.0)
    assert rules.at(0.0) == [] and rules.at(1.0, **fields) == ["firing"]


def test_nothing_is_sent_while_muted_or_after_a_maintenance():
    rules = Looked(health="suspect", after=0.0, clear=1.0, maintenance=100.0)
    bad = {"health": "suspect"}
    assert rules.at(0.0, **bad) == ["firing"]
    rules.engine.mute = AlertMute(sys.float_info.max)
    assert rules.at(1.0) == rules.at(5.0) == rules.at(6.0) == []
    rules.engine.mute = AlertMute(0.0)
    assert rules.at(7.0) == ["resolved"]
    assert rules.at(8.0, model_version=2, **bad) == rules.at(107.9, model_version=2, **bad) == []
    assert rules.at(108.0, model_version=2, **bad) == ["firing"]


def started(receivers, alerts="[{state: temperature, above: 45, after: 0, clear: 0}]"):
    """A twin whose measurements come by `push`, with receivers of alerts. Its estimate holds on the slowest machine."""
    ever = dict.fromkeys(("time.degraded_after", "time.stale_after"), "1000000")
    return pushed_twin({"receivers": receivers}, alerts=alerts, **ever)


DEAD = {"type": "webhook", "url": "http://127.0.0.1:9/"}


def test_every_receiver_gets_the_alert_although_one_is_dead(serve, hook, monkeypatch):
    monkeypatch.setenv("NISUS_TEST_SECRET", "a key")
    ops = hook.section | {"secret_env": "NISUS_TEST_SECRET", "heartbeat": 3600}
    with publishing(serve, started({"dead": DEAD, "ops": ops}), page="http://127.0.0.1:9900") as page:
        wait_for(lambda: [item["status"] for item in hook.alerts] == ["heartbeat"])
        for k in range(30):
            push(page, (k, 50.0))
        wait_for(lambda: [item["status"] for item in hook.alerts] == ["heartbeat", "firing"])
        alert = hook.alerts[1]
        probability = norm.sf(45.0, alert["value"], alert["std"])
        assert alert["probability"] == pytest.approx(probability, rel=1e-12) and probability >= 0.5
        assert alert["link"] == "http://127.0.0.1:9900/alarms#limit-of-a-state" and alert["response"]
        headers, body = hook.received[-1]
        signed = headers["X-Nisus-Timestamp"].encode() + b"." + body
        assert headers["X-Nisus-Signature"] == "sha256=" + hmac.new(b"a key", signed, hashlib.sha256).hexdigest()
        wait_for(lambda: page.get("/api/alerts")["receivers"][0]["failing"])
        wait_for(lambda: [item["waiting"] for item in page.get("/api/alerts")["receivers"]] == [1, 0])
        found = page.get("/api/alerts")
        assert [(item["rule"], item["subject"]) for item in found["alerts"]] == [("temperature-above", "temperature")]
        lines = notice_texts(page.engine)
        assert sum("receiver dead fails" in line for line in lines) == 1
        for k in range(30, 80):
            push(page, (k, 40.0))
        wait_for(lambda: hook.alerts[-1]["status"] == "resolved")
        assert hook.alerts[-1]["id"] == alert["id"]


class Receiver:
    """Takes alerts unless it is dead."""

    def __init__(self, dead=True):
        self.dead, self.got = dead, []

    def send(self, alert):
        if self.dead:
            raise OSError("refused")
        self.got.append(alert)


def delivering(receiver):
    """The delivery to a receiver, whose steps are those of the test, and what it says."""
    said = []
    notices = SimpleNamespace(say=lambda text, level="info": said.append(text), count=lambda key: None)
    return Delivery("ops", receiver, notices), said


def test_a_receiver_that_failed_gets_what_waited_in_order_and_a_full_queue_drops_the_oldest():
    receiver = Receiver()
    delivery, said = delivering(receiver)
    alerts = [
        heartbeat("motor", "tracking").model_copy(update={"status": "firing", "sent": str(k)})
        for k in range(MAX_WAITING_ALERTS + 2)
    ]
    for alert in alerts:
        delivery.put(alert)
    assert [delivery.step() for _ in range(9)] == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0, 60.0]
    assert (delivery.dropped, delivery.failing) == (2, True)
    receiver.dead = False
    delivery.step()
    assert receiver.got == alerts[2:] and not delivery.waiting
    assert said == [
        "alerts: receiver ops fails (refused); they wait, and it is tried again",
        "alerts: receiver ops takes them again",
    ]


def assert_fails(receiver, reason):
    """An alert waits, is tried again, and the failure is told in one line."""
    delivery, said = delivering(receiver)
    delivery.put(heartbeat("motor", "tracking"))
    assert delivery.step() == 1.0 and delivery.step() == 2.0
    assert delivery.failing and delivery.waiting == 1
    (line,) = said
    assert reason in line and "\n" not in line


def test_a_mute_is_asked_for_by_a_command(serve):
    page = serve(3)
    page.post("/api/command", command="MuteAlerts", seconds=3600, reason="cleaning")
    wait_for(lambda: page.engine.mute is not None and page.engine.mute.active)
    assert "alerts are muted for 60 min: cleaning" in notice_texts(page.engine)


@cases(__file__, "refused_rules.csv")
def test_a_rule_that_means_nothing_is_refused_in_one_line(outputs, alerts, text):
    overrides = {"outputs": outputs, "alerts": alerts}
    assert text in error_of(ConfigError, load_twin, "motor_winding", overrides=overrides)


@cases(__file__, "no_secrets.csv")
def test_a_secret_that_is_not_set_is_one_line_with_its_place(serve, outputs, key, tmp_path, monkeypatch):
    monkeypatch.delenv("NISUS_NO_SECRET", raising=False)
    text = load_twin("motor_winding").loaded.text.rstrip() + f"\noutputs:\n  {outputs}\n"
    (tmp_path / "pump.yaml").write_text(text)
    page = serve()
    page.engine.twin = load_twin(tmp_path / "pump.yaml")
    line = text.splitlines().index(next(line for line in text.splitlines() if "NO_SECRET" in line)) + 1
    rule = "is NISUS_NO_SECRET, an environment variable that is not set; set it before the start"
    assert error_of(ConfigError, Publisher, page.engine) == f"{tmp_path / 'pump.yaml'}:{line}: outputs.{key} {rule}"
