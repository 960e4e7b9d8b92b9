"""Live: the loop that keeps a session and its page going, in real time."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from threading import Event, Thread

from ir_maniskill.environment.touch_env import CONTROL_FREQ
from ir_maniskill.talk.film import Film
from ir_maniskill.talk.page import Page
from ir_maniskill.talk.session import Session

log = logging.getLogger(__name__)

FRAME = 1 / 30
"""How often bodies are drawn, between steps too [s]."""
IDLE = 0.05
"""How long to wait where nothing goes on [s]."""
MOMENT = 0.005
"""How long to wait for the time of a step [s]."""
SMOOTHING = 0.1
"""Share of the newest step in the mean time that steps take."""


class Clock:
    """When steps are due, and how fast they really come."""

    def __init__(self) -> None:
        """Start now."""
        self.restart()

    def restart(self) -> None:
        """Forget what was before; a step is due."""
        self._due = time.perf_counter()
        self.period = 1 / CONTROL_FREQ
        """Mean time from a step to the next one [s]."""
        self._last = self._due - self.period

    @property
    def due(self) -> bool:
        """Whether it is time for the next step."""
        return time.perf_counter() >= self._due

    def tick(self, speed: float) -> None:
        """Take note of a step; a late one is not made up for."""
        now = time.perf_counter()
        self.period += SMOOTHING * (now - self._last - self.period)
        self._last = now
        self._due = max(self._due + 1 / (CONTROL_FREQ * speed), now)

    def pace(self, speed: float) -> str:
        """Say how fast it goes."""
        rate, wanted = 1 / self.period, CONTROL_FREQ * speed
        slow = ": as fast as this machine can" if rate < 0.85 * wanted else ""
        return f"{rate:.0f} of {wanted:.0f} steps a second{slow}"


def run(session: Session, host: str, port: int, record: Path | None = None) -> None:
    """Keep the page open until Ctrl-C; while nobody watches, nothing moves.

    Args:
        session: Who is talked to.
        host: Address to listen at.
        port: Port to listen at, or the next one that is free.
        record: Film to write in the end (.mp4, .gif).
    """
    for chatty in ("websockets", "ir_maniskill.language.tokens"):
        logging.getLogger(chatty).setLevel(logging.CRITICAL)  # the page tells it
    film = None if record is None else Film()
    with closing(session), closing(Page(session, host, port)) as page:
        log.info("Open %s in a browser; Ctrl-C ends it.", page.address)
        with suppress(KeyboardInterrupt):
            keep_going(page, film)
    if film is not None and record is not None:
        drawn = film.write(record)
        where = f"The film is in {record}." if drawn else "Nobody watched: no film."
        log.info(where)


def keep_going(page: Page, film: Film | None = None, until: float = math.inf) -> None:
    """Step and obey, until a time of `time.perf_counter` [s]."""
    clock = Clock()
    with _drawing(page):
        while time.perf_counter() < until:
            if page.obey():
                page.refresh()
            if page.paused or not page.watched:
                page.show_pace("paused" if page.paused else "nobody watches")
                time.sleep(IDLE)
                clock.restart()
            elif clock.due:
                page.attempt(page.session.step)
                if film is not None:
                    film.add(page.session)
                clock.tick(page.speed)
                page.show_step(clock.period)
                page.show_pace(clock.pace(page.speed))
            else:
                time.sleep(MOMENT)


@contextmanager
def _drawing(page: Page) -> Iterator[None]:
    """Draw the bodies on a thread of its own: motion is smooth if steps take long."""
    over = Event()

    def draw() -> None:
        while not over.wait(FRAME):
            page.stage.draw()

    thread = Thread(target=draw)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
