"""`python -m tests.shots [name ...]`: take the pictures of README and guides from the running page, in Chromium.

Twins run from their own seeds and recordings and pause at a given time where their source can, so two pictures of one
commit differ little. Without names all are taken, and the animation: a swap of the filter and a drag of Q.
"""

import io
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from PIL import Image, ImageDraw
from playwright.sync_api import Browser, Page

from app.cli.open_twin import live_source
from app.engine.commands import InjectFault, Pause, SetEstimator, SetTunings
from app.twin.twin import load_twin
from app.web.running import OpenedTwin
from app.web.session import Page as Served
from app.web.session import Session
from tests.chromium import find_chromium, launched

PICTURES = Path(__file__).resolve().parent.parent / "config" / "pictures"
SIZE = {"width": 1440, "height": 900}
SMALL = {"width": 1200, "height": 750}
COLORS = 200
"""Colours of a picture: enough for charts and scenes, and a third of the bytes."""

STEP_TIMEOUT_S = 240.0
"""For one step, with filters that are compiled first."""

SETTLING_S = 4.0
"""Until charts and scene are drawn; a scene drawn without a graphics card takes that long."""

ANIMATED, MAX_ANIMATION_BYTES = "swap_and_drag.webp", 2_000_000
POINTER = [(0, 0), (0, 17), (4, 13), (7, 20), (10, 19), (7, 12), (12, 12)]


class Shot(NamedTuple):
    """Twin, time in its log at which the picture is taken, and speed of the replay until then.

    name: Of the picture; empty for the twin's. act: Done at that time, for example an edit. tab: Opened afterwards.
    """

    twin: str
    second: float
    speed: float
    name: str = ""
    act: Callable[[Session], None] | None = None
    tab: str = ""

    @property
    def file(self) -> str:
        """Name of the picture."""
        return f"{self.name or self.twin}.png"


def inject_bias(session: Session) -> None:
    """Let the yoke read 6 °C too high for 15 s."""
    begun = elapsed(session)
    session.engine.submit(Pause(False))
    session.engine.submit(InjectFault("bias", "yoke", 6.0))
    until(lambda: elapsed(session) >= begun + 15.0)


def lower_q(session: Session) -> None:
    """Make the filter overconfident: divide the process noise by 100."""
    session.engine.submit(SetTunings({"Q.temperature": 1e-4, "Q.rate": 1e-5}))
    time.sleep(SETTLING_S)


SHOTS = (
    Shot("motor_can", 45, 1, "fault_detection", inject_bias),
    Shot("motor_can", 45, 1, "what_if", tab="What if"),
    Shot("motor_winding", 60, 4, "overconfident", lower_q),
    Shot("motor_can", 45, 1),
    Shot("road_car", 900, 60),
    Shot("battery_pack", 900, 60),
    Shot("agv_corridor", 16.5, 4),
    Shot("uwb_rover_plaza", 240, 20),
    Shot("motor_bench_joint", 1200, 100),
    Shot("lorenz63", 24, 4),
    Shot("lorenz96", 24, 4),
    Shot("gripper_contact", 17, 2),
    Shot("thermal_field", 90, 4),
    Shot("field_era5", 72 * 3600, 10_000),
)


def until(condition: Callable[[], object], seconds: float = STEP_TIMEOUT_S) -> None:
    """Wait for something.

    Raises:
        TimeoutError: If it does not come.
    """
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError("the page did not come to where its picture is to be taken")
        time.sleep(0.05)


def elapsed(session: Session) -> float:
    """Seconds of the log so far."""
    first, last = session.engine.span()
    return (last - first) / 1e9


@contextmanager
def shown(browser: Browser, shot: Shot, size: dict[str, int]) -> Iterator[tuple[Session, Page]]:
    """The page of a twin, once its log is so long, and paused there if it can be."""
    twin = load_twin(shot.twin)
    session = Session(OpenedTwin(twin, live_source(twin, shot.speed)), page=Served(0, open_browser=False))
    session.start()
    context = browser.new_context(viewport=size, color_scheme="light")  # type: ignore[arg-type]
    try:
        page = context.new_page()
        page.goto(session.url)
        until(lambda: elapsed(session) >= shot.second or session.engine.status().finished)
        if shot.act is not None:
            shot.act(session)
        session.engine.submit(Pause(True))
        until(lambda: page.evaluate("window.nisus?.drawn > 0"))
        if shot.tab:
            page.get_by_role("tab", name=shot.tab, exact=True).click()
        time.sleep(2 * SETTLING_S)
        yield session, page
    finally:
        context.close()
        session.stop()


def picture(page: Page) -> Image.Image:
    """What the page shows now."""
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB")


def take(browser: Browser, shot: Shot) -> None:
    """Make one picture."""
    with shown(browser, shot, SIZE) as (_, page):
        small = picture(page).quantize(COLORS, dither=Image.Dither.NONE)
        small.save(PICTURES / shot.file, optimize=True)


class Film:
    """Frames of a page, with the pointer that a screenshot leaves out."""

    def __init__(self, page: Page) -> None:
        self.page, self.frames, self.times = page, list[Image.Image](), list[int]()
        self.at = (700.0, 400.0)

    def frame(self, milliseconds: int) -> None:
        """Take what the page shows, for that long."""
        image = picture(self.page)
        draw = ImageDraw.Draw(image)
        draw.polygon([(self.at[0] + x, self.at[1] + y) for x, y in POINTER], fill="#14202f", outline="#ffffff")
        self.frames.append(image)
        self.times.append(milliseconds)

    def move(self, x: float, y: float, frames: int, milliseconds: int = 90) -> None:
        """Move the pointer there in so many frames."""
        from_x, from_y = self.at
        for k in range(1, frames + 1):
            self.at = (from_x + (x - from_x) * k / frames, from_y + (y - from_y) * k / frames)
            self.page.mouse.move(*self.at)
            self.frame(milliseconds)

    def save(self, path: Path) -> None:
        """Write it.

        Raises:
            ValueError: If it is larger than a README should bear.
        """
        first, *others = self.frames
        first.save(path, save_all=True, append_images=others, duration=self.times, loop=0, quality=62, method=6)
        if path.stat().st_size > MAX_ANIMATION_BYTES:
            raise ValueError(f"{path} has {path.stat().st_size} bytes; it should have {MAX_ANIMATION_BYTES} at most")


def animate(browser: Browser) -> None:
    """A filter that takes contact for a number gives way to one of modes; then Q of the slip is dragged up and down."""
    with shown(browser, Shot("gripper_contact", 17, 4), SMALL) as (session, page):

        def settled() -> bool:
            return not session.engine.status().refolding

        session.engine.submit(SetEstimator("ekf"))
        until(lambda: session.engine.status().estimator == "ekf" and settled())
        time.sleep(SETTLING_S)
        film = Film(page)
        film.frame(1500)
        choice = page.get_by_label("Estimator", exact=True)
        box = choice.bounding_box()
        assert box is not None
        film.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"], 5)
        choice.select_option("rbpf")
        film.frame(300)
        until(lambda: session.engine.status().estimator == "rbpf" and settled())
        time.sleep(SETTLING_S)
        film.frame(1800)
        slider = page.locator('[data-key="Q.slip"] input[type=range]')
        box = slider.bounding_box()
        assert box is not None
        middle = box["y"] + 0.5 * box["height"]
        film.move(box["x"] + 0.5 * box["width"], middle, 5)
        page.mouse.down()
        for share, frames in ((0.85, 7), (0.2, 12), (0.5, 6)):
            target, (start, _) = box["x"] + share * box["width"], film.at
            for k in range(1, frames + 1):
                film.at = (start + (target - start) * k / frames, middle)
                page.mouse.move(*film.at)
                time.sleep(0.3)  # until the edit is there
                until(settled)
                time.sleep(0.5)
                film.frame(900 if k == frames else 130)
        page.mouse.up()
        film.save(PICTURES / ANIMATED)


def main(names: list[str]) -> None:
    """Take the pictures with these names, or all."""
    with launched(find_chromium()) as browser:
        for shot in SHOTS:
            if not names or shot.file.removesuffix(".png") in names:
                take(browser, shot)
                print(shot.file, flush=True)
        if not names or ANIMATED in names:
            animate(browser)
            print(ANIMATED, flush=True)
        browser.close()


if __name__ == "__main__":
    main(sys.argv[1:])
