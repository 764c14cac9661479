"""Alerts: rules on health, episodes, NIS, limits of states and loss of the twin, and their delivery to receivers.

A condition that lasts is one alert: firing, repeated after a time, resolved. Each receiver has a queue and takes its
alerts in a thread of its own pool, so that a dead one delays neither the twin nor the others.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import os
import smtplib
import ssl
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from email.message import EmailMessage
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol
from urllib.error import HTTPError, URLError
from urllib.request import HTTPRedirectHandler, Request, build_opener

from pydantic import BaseModel, ConfigDict, Field

from config.output_schema import AlertSection, CommandSection, EmailSection, WebhookSection
from estimators.diagnostics.detectors import anchor
from estimators.errors import ConfigError, printable
from estimators.track import HEALTH_NAMES

from ..live.jobs import Job
from ..live.notices import Notices
from ..present.export.alarm_guide import advice
from ..present.state_message import StateMessage, iso_now

if TYPE_CHECKING:
    from ..live.running_fold import Running

SCHEMA: Literal["nisus.alert/1"] = "nisus.alert/1"

FIRING, REPEATED, RESOLVED, HEARTBEAT = "firing", "repeated", "resolved", "heartbeat"

MAX_WAITING_ALERTS = 100
"""Alerts that wait for a receiver; then the oldest is dropped."""

DELIVERY_PERIOD_S, MAX_RETRY_S = 0.2, 60.0
"""Between two looks at the queue of a receiver, and the longest wait after it has failed."""

TIMEOUT_S = 10.0
"""Longest wait for a web or mail server."""

GUIDES = LIMIT_GUIDE, NIS_GUIDE, LOST_GUIDE = "limit of a state", "nis above its limit", "loss of the twin"
"""Headings in docs/alarms.md of alerts that are no health and no cause of an episode."""


class AlertMessage(BaseModel):
    """One alert, as receivers get it."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    version: Literal["nisus.alert/1"] = SCHEMA
    twin: str
    id: str = Field(description="equal in all messages of one alert; another for the next alert of the same rule")
    status: Literal["firing", "repeated", "resolved", "heartbeat"]
    rule: str
    subject: str = Field(description="sensor or state concerned, or twin")
    text: str = Field(description="one line: what happened, value and limit")
    health: str
    since: str = Field(description="beginning of the condition, ISO 8601 in UTC, by the clock of this machine")
    sent: str = Field(description="time of this message, likewise")
    value: float | None = Field(description="estimate or NIS concerned, null if there is none")
    std: float | None = Field(description="standard deviation of the estimate")
    limit: float | None
    probability: float | None = Field(description="that the state is beyond the limit")
    unit: str
    guide: str = Field(description="section of the guide with diagnosis and response")
    link: str | None = Field(description="the same on the page of the twin; null without a page")
    response: str = Field(description="response by the guide")


class Finding(NamedTuple):
    """A condition of a rule that holds."""

    subject: str
    text: str
    guide: str
    value: float | None = None
    std: float | None = None
    limit: float | None = None
    probability: float | None = None
    unit: str = ""
    key: str = ""


def findings(rule: AlertSection, engine: Running, message: StateMessage) -> Iterator[Finding]:
    """Yield the conditions of a rule that hold for a state."""
    if rule.health is not None and HEALTH_NAMES.index(message.health) >= HEALTH_NAMES.index(rule.health):
        leading = next((item for item in engine.episodes() if item.end is None and item.text == message.cause), None)
        guide = message.health if leading is None else leading.cause
        yield Finding("twin", f"{message.health}: {message.cause or 'see the guide'}", guide)
    if rule.episode is not None:
        for item in engine.episodes():
            if item.end is None and ("all" in rule.episode or item.cause in rule.episode):
                size = item.size if math.isfinite(item.size) else None
                key = f"{item.cause} {item.start}"
                yield Finding(item.subject, item.text, item.cause, value=size, unit=item.unit, key=key)
    if rule.nis is not None and message.nis is not None and message.nis > rule.nis:
        text = f"NIS is {message.nis:.2f} times its expected value, above {rule.nis:g}"
        yield Finding("twin", text, NIS_GUIDE, value=message.nis, limit=rule.nis)
    if rule.state is not None:
        limit = rule.above if rule.above is not None else rule.below
        assert limit is not None
        for state in message.states:
            if state.name == rule.state and state.value is not None and state.std is not None:
                over = state.value - limit if rule.above is not None else limit - state.value
                probability = tail(over, state.std)
                if probability >= rule.probability:
                    side = "above" if rule.above is not None else "below"
                    text = f"{state.name} is {state.value:.4g} ± {state.std:.2g} {state.unit}, with {probability:.1%} "
                    text += f"{side} {limit:g} {state.unit}"
                    numbers = state.value, state.std, limit, probability, state.unit
                    yield Finding(state.name, text, LIMIT_GUIDE, *numbers)
    if rule.lost is not None and message.age_s is not None and message.age_s > rule.lost:
        yield Finding("twin", f"nothing has come for {message.age_s:.0f} s", LOST_GUIDE, value=message.age_s, unit="s")


def tail(over: float, std: float) -> float:
    """Return the probability that a Gaussian of this deviation, whose mean is `over` a limit, is beyond it."""
    if std == 0.0:
        return float(over > 0.0)
    return 0.5 * math.erfc(-over / (std * math.sqrt(2.0)))


class OpenAlert:
    """A condition from its beginning until its end is certain. Times are monotonic, s."""

    def __init__(self, key: tuple[str, ...], rule: AlertSection, finding: Finding, now: float) -> None:
        self.rule, self.finding = rule, finding
        self.begun = self.seen = now
        self.since = iso_now()
        self.id = hashlib.sha256("|".join((*key, self.since)).encode()).hexdigest()[:16]
        self.sent: float | None = None


class AlertRules:
    """Decides which alerts to send; not for several threads at once."""

    def __init__(
        self, rules: Sequence[AlertSection], *, link: str | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`link`: address of the page, without the token; `clock` returns seconds."""
        self._rules, self._link, self._clock = tuple(rules), link, clock
        self._open: dict[tuple[str, ...], OpenAlert] = {}
        self._version: int | None = None
        self._maintained = -math.inf

    @property
    def open(self) -> tuple[OpenAlert, ...]:
        """Alerts that were sent and are not resolved, oldest first."""
        return tuple(item for item in self._open.copy().values() if item.sent is not None)

    def look(self, engine: Running, message: StateMessage) -> list[tuple[AlertSection, AlertMessage]]:
        """Return the messages to send now, each with its rule.

        Conditions of an estimate that is not known, because the state is waiting, neither begin nor end.
        """
        now, due = self._clock(), []
        if self._version is not None and message.model_version > self._version:
            self._maintained = now
        self._version = message.model_version
        for k, rule in enumerate(self._rules):
            for found in findings(rule, engine, message):
                key = str(k), rule.title, found.subject, found.key
                entry = self._open.setdefault(key, OpenAlert(key, rule, found, now))
                entry.finding, entry.seen = found, now
        muted = engine.mute is not None and engine.mute.active
        for place, entry in list(self._open.items()):
            rule = entry.rule
            quiet = muted or now - self._maintained < rule.maintenance
            lasts = entry.seen == now
            over = not lasts and now - entry.seen >= rule.clear
            if over and (entry.sent is None or not quiet):
                del self._open[place]
                if entry.sent is not None:
                    due.append((rule, self._message(entry, RESOLVED, message)))
            elif lasts and not quiet and now - entry.begun >= rule.after:
                first = entry.sent is None
                again = rule.repeat != "never" and entry.sent is not None and now - entry.sent >= rule.repeat
                if first or again:
                    entry.sent = now
                    due.append((rule, self._message(entry, FIRING if first else REPEATED, message)))
        return due

    def _message(self, entry: OpenAlert, status: Any, message: StateMessage) -> AlertMessage:
        found, place = entry.finding, anchor(entry.finding.guide)
        return AlertMessage(
            twin=message.twin,
            id=entry.id,
            status=status,
            rule=entry.rule.title,
            subject=found.subject,
            text=printable(found.text) if status != RESOLVED else f"no longer: {printable(found.text)}",
            health=message.health,
            since=entry.since,
            sent=iso_now(),
            value=found.value,
            std=found.std,
            limit=found.limit,
            probability=found.probability,
            unit=found.unit,
            guide=f"docs/alarms.md#{place}",
            link=None if self._link is None else f"{self._link}/alarms#{place}",
            response=advice(found.guide, "Response"),
        )


def heartbeat(twin: str, health: str) -> AlertMessage:
    """Return the message that a twin runs."""
    sent = iso_now()
    rest: dict[str, Any] = dict.fromkeys(("value", "std", "limit", "probability", "link"))
    rest |= {"rule": HEARTBEAT, "subject": "twin", "text": "the twin runs", "unit": "", "response": ""}
    rest |= {"twin": twin, "id": HEARTBEAT, "status": HEARTBEAT, "health": health, "since": sent, "sent": sent}
    return AlertMessage(guide=f"docs/alarms.md#{anchor(LOST_GUIDE)}", **rest)


class Receiver(Protocol):
    """Sends alerts to one place."""

    def send(self, alert: AlertMessage) -> None:
        """Send one, within seconds.

        Raises:
            OSError: If it was not received.
        """


class KeptRequest(HTTPRedirectHandler):
    """Follows no redirect: a signed alert goes to the address that was configured, or nowhere."""

    def redirect_request(self, *args: Any, **more: Any) -> None:
        """Return no request."""


class Webhook:
    """Sends alerts by POST; the signature is that of the time, a dot, and the body."""

    def __init__(self, section: WebhookSection) -> None:
        self._url = secret(section.url[1:]) if section.url.startswith("$") else section.url
        self._key = None if section.secret_env is None else secret(section.secret_env).encode()
        self._open = build_opener(KeptRequest)

    def send(self, alert: AlertMessage) -> None:
        """See `Receiver`."""
        body, stamp = alert.model_dump_json().encode(), str(int(time.time()))
        headers = {"Content-Type": "application/json", "User-Agent": "nisus", "X-Nisus-Timestamp": stamp}
        if self._key is not None:
            signature = hmac.new(self._key, stamp.encode() + b"." + body, hashlib.sha256).hexdigest()
            headers["X-Nisus-Signature"] = f"sha256={signature}"
        try:
            self._open.open(Request(self._url, body, headers), timeout=TIMEOUT_S).close()
        except HTTPError as error:
            error.close()
            raise OSError(f"it answers {error.code}") from None
        except URLError as error:
            raise OSError(str(error.reason)) from None
        except ValueError as error:  # an address that is none, from the environment
            raise OSError(str(error)) from None


class Mail:
    """Sends alerts as e-mail."""

    def __init__(self, section: EmailSection) -> None:
        self._section = section
        self._password = None if section.password_env is None else secret(section.password_env)

    def send(self, alert: AlertMessage) -> None:
        """See `Receiver`."""
        section, mail = self._section, EmailMessage()
        mail["Subject"] = f"[{alert.twin}] {alert.status}: {alert.rule}"
        mail["From"], mail["To"] = section.sender, ", ".join(section.to)
        lines = [alert.text, "", f"Since {alert.since}; health is {alert.health}.", f"Response: {alert.response}"]
        mail.set_content("\n".join([*lines, alert.link or alert.guide, "", alert.model_dump_json(indent=2)]))
        context = ssl.create_default_context()
        try:
            if section.security == "tls":
                server: smtplib.SMTP = smtplib.SMTP_SSL(
                    section.server, section.port, timeout=TIMEOUT_S, context=context
                )
            else:
                server = smtplib.SMTP(section.server, section.port, timeout=TIMEOUT_S)
            with server:
                if section.security == "starttls":
                    server.starttls(context=context)
                if section.user is not None and self._password is not None:
                    server.login(section.user, self._password)
                server.send_message(mail)
        except smtplib.SMTPException as error:
            raise OSError(str(error)) from None


class CommandReceiver:
    """Starts a program for each alert."""

    def __init__(self, section: CommandSection, folder: Path) -> None:
        """`folder`: of the YAML."""
        program, *arguments = section.command
        self._command = [str(folder / program) if program.startswith("./") else program, *arguments]
        self._timeout = section.timeout

    def send(self, alert: AlertMessage) -> None:
        """See `Receiver`."""
        text = alert.model_dump_json()
        try:
            # A file, not a pipe: what the program leaves running would hold that open.
            with tempfile.TemporaryFile() as said:
                code = subprocess.run(
                    self._command, input=text.encode(), stdout=subprocess.DEVNULL, stderr=said, timeout=self._timeout
                ).returncode
                said.seek(max(0, said.tell() - 1000) if code else 0)
                last = (said.read(1000).decode(errors="replace").strip().splitlines() or [""])[-1]
        except subprocess.TimeoutExpired:
            raise OSError(f"it did not end within {self._timeout:g} s") from None
        if code:
            raise OSError(f"it ended with {code}{': ' if last else ''}{last}")


def secret(name: str) -> str:
    """Return the value of an environment variable.

    Raises:
        ConfigError: If it is not set.
    """
    value = os.environ.get(name)
    if not value:
        raise ConfigError(f"outputs: the environment variable {name} is not set; set it before the twin starts")
    return value


class Delivery:
    """Queue of one receiver; `step` is a repeated job."""

    def __init__(self, name: str, receiver: Receiver, notices: Notices) -> None:
        self.name, self._receiver, self._notices = name, receiver, notices
        self._waiting: deque[AlertMessage] = deque()
        self._lock = threading.Lock()
        self._failures = 0
        self.delivered = self.dropped = 0

    @property
    def failing(self) -> bool:
        """Whether the last attempt failed."""
        return self._failures > 0

    @property
    def waiting(self) -> int:
        """Alerts that wait."""
        return len(self._waiting)

    def put(self, alert: AlertMessage) -> None:
        """Add an alert to the queue; of a full one the oldest is dropped."""
        with self._lock:
            if alert.status == HEARTBEAT and self._waiting:
                return
            if len(self._waiting) >= MAX_WAITING_ALERTS:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(alert)

    def step(self, job: Job | None = None) -> float:
        """Send the alerts that wait, in order; return the seconds until the next call."""
        while self._waiting and (job is None or job.wanted):
            alert = self._waiting[0]
            try:
                self._receiver.send(alert)
            except Exception as error:  # noqa: BLE001  an answer of no protocol, or what a program prints
                return self._failed(error)
            with self._lock:
                # A full queue may have dropped it meanwhile.
                if self._waiting and self._waiting[0] is alert:
                    self._waiting.popleft()
            self.delivered += 1
            if self._failures:
                self._notices.say(f"alerts: receiver {self.name} takes them again")
                self._failures = 0
        return DELIVERY_PERIOD_S

    def _failed(self, error: Exception) -> float:
        self._failures += 1
        pause = min(MAX_RETRY_S, 2.0 ** min(self._failures - 1, 10))
        # One line an outage; each failure is counted.
        self._notices.count("alert receiver")
        if self._failures == 1:
            reason = str(getattr(error, "strerror", None) or error) or type(error).__name__
            text = " ".join(printable(reason).split())[:200]
            self._notices.say(f"alerts: receiver {self.name} fails ({text}); they wait, and it is tried again", "warn")
        return pause


def make_receivers(sections: Mapping[str, Any], folder: Path, mqtt: Receiver | None) -> dict[str, Receiver]:
    """Return the receivers by name.

    Raises:
        ConfigError: If a secret is not in the environment, or there is no broker.
    """
    found: dict[str, Receiver] = {}
    for name, section in sections.items():
        if isinstance(section, WebhookSection):
            found[name] = Webhook(section)
        elif isinstance(section, EmailSection):
            found[name] = Mail(section)
        elif isinstance(section, CommandSection):
            found[name] = CommandReceiver(section, folder)
        elif mqtt is not None:
            found[name] = mqtt
    return found
