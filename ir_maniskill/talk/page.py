"""Page: the panel beside the stage; what visitors do there waits in a queue."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from typing import Any

import numpy as np
import viser
from PIL import Image

from ir_maniskill import experiment as catalog
from ir_maniskill.checks import ConfigError, require_whole
from ir_maniskill.talk import cards
from ir_maniskill.talk.players import RANDOM
from ir_maniskill.talk.session import PAPER, Session, robots
from ir_maniskill.talk.stage import Stage

log = logging.getLogger(__name__)

PICTURE, ROW = 224, 366
"""Height of the policy's pictures on the page, and width of their row [pixel]."""
GAP = 12
"""Between two pictures [pixel]."""
BACKGROUND = 36
"""The panel's gray."""
SPEEDS = (0.1, 2.0)
"""How slow and how fast it may go; 1 is real time."""
EXAMPLES = 9
"""Most examples that are shown."""


class Server(viser.ViserServer):
    """viser's server, without its way out into the internet."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Share nothing, whoever asks."""


class Page:
    """A page that shows a session to all who open it; they share it.

    Visitors' wishes come on the server's threads. They wait in a queue until the
    simulator's thread obeys, since nothing else may touch the session.
    """

    def __init__(self, session: Session, host: str, port: int) -> None:
        """Open the page.

        Raises:
            ValueError: It cannot listen at that address.
        """
        require_whole("port", port, 0, 65535)
        try:  # viser would wait for ever
            family, *_, address = socket.getaddrinfo(host, 0)[0]
            socket.create_server(address, family=family).close()
        except OSError as error:
            expected = f"an address of this machine ({error})"
            raise ConfigError(f"host: got {host!r}, expected {expected}") from None
        self.session = session
        self.paused, self.speed = False, 1.0
        self._wishes: SimpleQueue[Callable[[], None]] = SimpleQueue()
        with _silence():  # viser greets at length
            self.server = Server(
                host=host, port=port, label="Talk to it", verbose=False
            )
        gui = self.server.gui
        gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False,
            control_width="large", brand_color=(64, 160, 110),
        )  # fmt: skip
        gui.main_panel.dock_right()
        self.stage = Stage(
            self.server,
            drag=lambda *place: self._wish(session.drag, *place),
            drop=lambda: self._wish(session.drop),
        )
        # Who leaves in the middle of a drag lets go of nothing.
        self.server.on_client_disconnect(lambda _: self._wish(session.drop))
        self._add_talk()
        self._add_time()
        self._add_choice()
        self.refresh()

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    @property
    def watched(self) -> bool:
        """Whether anybody has it open."""
        return bool(self.server.get_clients())

    def close(self) -> None:
        """Close it."""
        with _silence():
            self.server.stop()

    # -- Wishes ------------------------------------------------------------------------

    def _wish(self, call: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
        self._wishes.put(lambda: call(*args, **kwargs))

    def obey(self) -> bool:
        """Do what visitors wished for; return whether there was anything."""
        wished = not self._wishes.empty()
        while not self._wishes.empty():
            self.attempt(self._wishes.get())
        return wished

    def attempt(self, call: Callable[[], None]) -> None:
        """Do something; if it fails, say so, and begin again in a new scene."""
        try:
            call()
        except Exception as error:  # no visitor's wish may end the page for all
            log.exception("talk: a wish failed")
            self.session.new_scene()
            self.session.note = f"That failed: {error}"

    # -- The panel ---------------------------------------------------------------------

    def _add_talk(self) -> None:
        gui = self.server.gui
        with gui.add_form(None) as form:
            line = gui.add_text("Say", self.session.reading.heard)
            gui.add_button("Say it", icon=viser.Icon.MESSAGE).on_click(
                lambda _: form.submit()
            )
        form.on_submit(lambda _: self._wish(self.session.tell, str(line.value)))
        self._sentence = gui.add_html("")
        self._lights = gui.add_html("")
        self._pictures = gui.add_image(side_by_side([]), format="png")
        with gui.add_folder("Try"):
            self._examples = [self._add_example(line) for _ in range(EXAMPLES)]
        self._note = gui.add_html("")

    def _add_example(self, line: Any) -> Any:
        button = self.server.gui.add_button("", visible=False, color="gray")

        @button.on_click
        def _(_: Any) -> None:
            line.value = button.label
            self._wish(self.session.tell, button.label)

        return button

    def _add_time(self) -> None:
        gui = self.server.gui
        speed = gui.add_slider("Speed", *SPEEDS, 0.1, 1.0)
        speed.on_update(lambda _: self._set_speed(float(speed.value)))
        buttons = gui.add_button_group("Scene", ("pause", "reset", "new scene"))

        @buttons.on_click
        def _(_: Any) -> None:
            match buttons.value:
                case "pause":
                    self.paused = not self.paused
                case "reset":
                    self._wish(self.session.reset)
                case "new scene":
                    self._wish(self.session.new_scene)

    def _set_speed(self, speed: float) -> None:
        if speed > 0:  # else it is no number
            self.speed = min(max(speed, SPEEDS[0]), SPEEDS[1])

    def _add_choice(self) -> None:
        gui, session = self.server.gui, self.session
        with gui.add_folder("The paper's experiments"):
            runs = gui.add_button_group("Run", tuple(PAPER))
            self._run = gui.add_html("")
        runs.on_click(lambda _: self._wish(session.experiment, PAPER[runs.value]))
        with gui.add_folder("Choose"):
            self._choices: dict[str, Any] = {
                "task": gui.add_dropdown("Task", catalog.available()),
                "robot": gui.add_dropdown("Robot", robots()),
                "policy": gui.add_dropdown("Policy", session.players()),
            }
        for kind, box in self._choices.items():
            box.on_update(partial(self._chosen, kind))

    def _chosen(self, kind: str, event: viser.GuiEvent) -> None:
        if event.client is not None:  # else it was us
            self._wish(self.session.choose, **{kind: event.target.value})

    # -- Drawing -----------------------------------------------------------------------

    def refresh(self) -> None:
        """Draw all: after a wish, which may have changed anything."""
        session = self.session
        players, choice = session.players(), session.choice
        self._choices["policy"].options = players
        for kind, box in self._choices.items():
            if box.value != getattr(choice, kind):
                box.value = getattr(choice, kind)
        if session.held is None:  # else they would change all the time
            self._offer(session.examples())
        self.show_step()

    def _offer(self, examples: list[str]) -> None:
        for place, button in enumerate(self._examples):
            button.visible = place < len(examples)
            if button.visible:
                button.label = examples[place]

    def show_step(self, lasts: float = 0.0) -> None:
        """Draw what a step changes; bodies move for as long as it lasts [s]."""
        session = self.session
        self.stage.show(session, lasts)
        self._put(self._sentence, cards.sentence_card(session.reading, session.score))
        self._put(self._lights, cards.lights_card(session.lights()))
        self._put(self._run, cards.run_card(session.run))
        pictures = list(session.pictures().values())
        self._pictures.visible = bool(pictures)
        if pictures:
            self._pictures.image = side_by_side(pictures)

    def show_pace(self, pace: str) -> None:
        """Say how fast it goes."""
        deaf = "Random motion: it does not listen."
        note = self.session.note or deaf * (self.session.choice.policy == RANDOM)
        self._put(self._note, cards.note_card(note, pace))

    def _put(self, card: Any, content: str) -> None:
        if card.content != content:
            card.content = content


def side_by_side(pictures: list[np.ndarray]) -> np.ndarray:
    """Return pictures in the middle of a row, as coarse as they are [H, W, 3] uint8."""
    row = Image.new("RGB", (ROW, PICTURE), (BACKGROUND,) * 3)
    ratios = [p.shape[1] / p.shape[0] for p in pictures]
    room = ROW - GAP * (len(ratios) - 1)
    high = min(PICTURE, int(room / sum(ratios))) if ratios else PICTURE
    wide = [int(high * ratio) for ratio in ratios]
    left, top = (room - sum(wide)) // 2, (PICTURE - high) // 2
    for picture, width in zip(pictures, wide, strict=True):
        coarse = len(picture) < high
        smooth = Image.Resampling.NEAREST if coarse else Image.Resampling.BOX
        row.paste(Image.fromarray(picture).resize((width, high), smooth), (left, top))
        left += width + GAP
    return np.asarray(row)


def _silence() -> contextlib.AbstractContextManager:
    return contextlib.redirect_stdout(io.StringIO())
