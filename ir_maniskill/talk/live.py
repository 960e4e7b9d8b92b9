"""Live: the loop that keeps a session and its page going, in real time."""

from __future__ import annotations

import logging
import math
import time
from contextlib import closing, suppress
from pathlib import Path

from ir_maniskill.environment.touch_env import CONTROL_FREQ
from ir_maniskill.talk.film import Film
from ir_maniskill.talk.page import Page
from ir_maniskill.talk.session import Session

log = logging.getLogger(__name__)

FRAME = 1 / 30
"""How often bodies are drawn, between steps too [s]."""
IDLE = 0.05
"""How long to wait where nothing goes on [s]."""
SMOOTHING = 0.1
"""Share of the newest step in the mean time that steps take."""


class Clock:
    """When steps are due, and how fast they really come."""

    def __init__(self) -> None:
        """Start now."""
        self._last = time.perf_counter()
        self._mean = 1 / CONTROL_FREQ

    def share(self, speed: float) -> float:
        """Return how much of the time until the next step has gone by, 1 at most."""
        gone = (time.perf_counter() - self._last) * CONTROL_FREQ * speed
        return min(gone, 1.0)

    def tick(self, speed: float) -> None:
        """Take note of a step; a late one is not made up for."""
        now, due = time.perf_counter(), self._last + 1 / (CONTROL_FREQ * speed)
        took = now - self._last
        self._mean += SMOOTHING * (took - self._mean)
        self._last = due if now - due < 0.5 / CONTROL_FREQ else now

    def pace(self, speed: float) -> str:
        """Say how fast it goes."""
        rate, wanted = 1 / self._mean, CONTROL_FREQ * speed
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
        frames = film.write(record)
        where = f"The film is in {record}." if frames else "Nobody watched: no film."
        log.info(where)


def keep_going(page: Page, film: Film | None = None, until: float = math.inf) -> None:
    """Step, draw and obey, until a time of `time.perf_counter` [s]."""
    clock = Clock()
    while time.perf_counter() < until:
        started = time.perf_counter()
        if page.obey():
            page.refresh()
        if page.paused or not page.watched:
            page.show_pace("paused" if page.paused else "nobody watches")
            time.sleep(IDLE)
            clock = Clock()
            continue
        if clock.share(page.speed) >= 1:
            page.attempt(page.session.step)
            if film is not None:
                film.add(page.session)
            clock.tick(page.speed)
            page.show_step()
            page.show_pace(clock.pace(page.speed))
        page.move(clock.share(page.speed))
        time.sleep(max(0.0, started + FRAME - time.perf_counter()))
