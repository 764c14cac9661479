"""All that watches the running fold, in threads of its own or as rows come, and says what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from estimators.log import Events
from estimators.track import TRACKING, WAITING

from .alerts import Alerts
from .blame import Blame
from .chronicle import Chronicle
from .counts import Latency
from .host_clock import HostClock
from .integrity import IntegrityWatch
from .interface import Running
from .silence import Silence

if TYPE_CHECKING:
    from estimators.diagnostics.episodes import Episode


class Watchers:
    """The watchers of one engine."""

    def __init__(self, engine: Running) -> None:
        section, notices = engine.twin.config.time, engine.notices
        self.latency = Latency()
        self.clock = HostClock(notices, section.horizon)
        self.chronicle = Chronicle(engine)
        self.alerts = Alerts(notices, lambda: self.chronicle.account.in_alarm)
        self.silence = Silence(notices, section.stale_after)
        self.integrity = IntegrityWatch(engine.last_events, engine.policy.false_alarm_every)
        self.blame = Blame(lambda: self.chronicle.account.episodes, engine.last_events, notices)

    def start(self) -> None:
        """Begin to watch."""
        self.chronicle.start()
        self.integrity.start()
        self.blame.start()

    @property
    def resting(self) -> tuple[Callable[[], None], ...]:
        """What ends those that fold."""
        return self.integrity.stop, self.blame.stop

    def stop(self) -> None:
        """Look at the last rows, and end."""
        self.chronicle.stop()

    def arrived(self, batch: Events, passed: Events) -> None:
        """A batch of a live source was folded; of it these passed."""
        self.latency.note(batch)
        self.clock.note(passed)

    def episodes(self) -> list[Episode]:
        """What was and is wrong, in the order of its start, with who is most likely off."""
        return list(map(self.blame.told, self.chronicle.account.episodes))

    def episodes_of(self, revision: int) -> tuple[Episode, ...]:
        """The same, if they are those of a revision; else none."""
        account = self.chronicle.account
        return tuple(map(self.blame.told, account.episodes)) if account.revision == revision else ()

    def cause(self, leading: Episode | None, health: int) -> str:
        """Why the twin is not to be trusted now, by the episode that leads, or that of a sensor which is behind it."""
        if leading is None or health in (WAITING, TRACKING):
            return ""
        return self.blame.told(self.blame.behind(leading)).text
