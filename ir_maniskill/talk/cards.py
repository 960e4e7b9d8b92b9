"""Cards: what the page's panel tells, as HTML. What a visitor typed is escaped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape

from ir_maniskill.environment.touch_env import CONTROL_FREQ
from ir_maniskill.evaluation.video import titles
from ir_maniskill.talk.reading import Reading
from ir_maniskill.talk.session import Run, Score

RIGHT, WRONG, TOUCH, OFF = "#40d280", "#f25454", "#6aa9ff", "#59606e"
"""Colors of a finger's light."""
COLORS = {"right": RIGHT, "wrong": WRONG, "touch": TOUCH, "": OFF}
FAINT = "color:#8b93a1;font-size:0.75rem"


def sentence_card(reading: Reading, score: Score) -> str:
    """Return what the robot is told, how that was understood, and what came of it."""
    rows = [f'<div style="font-size:1.15rem;font-weight:600">{_mark(reading)}</div>']
    title = "means" if reading.goal else "not understood:"
    rows.append(_row(title, escape(reading.meaning)))
    if reading.said != reading.heard:
        rows.append(_row("the policy hears", escape(reading.said)))
    if reading.unknown:
        words = ", ".join(map(escape, reading.unknown))
        rows.append(_row("words it never learned", words))
    if reading.guesses:
        rows.append(_row("it reads", ", ".join(map(escape, reading.guesses))))
    rows.append(f'<div style="margin-top:0.5em">{_outcome(reading, score)}</div>')
    return _card(rows)


def _mark(reading: Reading) -> str:
    """Return the sentence as it was typed, words that nobody knows in orange."""
    if reading.said != reading.heard:
        return escape(reading.heard)
    return " ".join(
        f'<span style="color:#f0a34a">{escape(word)}</span>'
        if word.lower().strip(".,!?") in reading.unknown
        else escape(word)
        for word in reading.heard.split()
    )


def _outcome(reading: Reading, score: Score) -> str:
    if reading.goal is None:
        chips = [_chip("not judged: the goal is unknown", OFF)]
    elif score.success:
        chips = [_chip("success", RIGHT)]
    elif score.success_once:
        chips = [_chip("was reached", RIGHT)]
    else:
        chips = [_chip("not yet", OFF)]
    if reading.goal is not None:
        wrong = f"{score.wrong} wrong touch{'es' * (score.wrong != 1)}"
        chips.append(_chip(wrong, WRONG if score.wrong else OFF))
    seconds = f"{score.steps / CONTROL_FREQ:.0f} s"
    return " ".join(chips) + f' <span style="{FAINT}">{seconds}</span>'


def lights_card(lights: Mapping[str, Mapping[str, str]]) -> str:
    """Return a row of lights for each hand."""
    rows = []
    for hand, fingers in lights.items():
        shown = zip(titles(tuple(fingers)), fingers.values(), strict=True)
        dots = "".join(_light(name, state) for name, state in shown)
        rows.append(
            f'<div style="display:flex;align-items:center;gap:0.9em">'
            f'<span style="{FAINT};width:3.2em">{escape(hand)}</span>{dots}</div>'
        )
    return _card(rows)


def _light(name: str, state: str) -> str:
    color = COLORS[state]
    glow = f"box-shadow:0 0 0.6em {color}" if state else ""
    return (
        '<span style="text-align:center;font-size:0.7rem">'
        f'<span style="display:block;width:1.1em;height:1.1em;border-radius:50%;'
        f'margin:0.2em auto;background:{color};{glow}"></span>{escape(name)}</span>'
    )


def run_card(run: Run | None) -> str:
    """Return how far a run of an experiment is."""
    if run is None:
        return ""
    rows = []
    for place, sentence in enumerate(run.sentences):
        done = place < len(run.reached)
        sign = ("✓" if run.reached[place] else "✗") if done else "·"
        color = (RIGHT if run.reached[place] else WRONG) if done else OFF
        bold = "font-weight:600" * (place == len(run.reached))
        rows.append(
            f'<div style="{bold}"><span style="color:{color}">{sign}</span> '
            f"{escape(sentence)}</div>"
        )
    if run.over:
        rows.append(f"{sum(run.reached)} of {len(run.reached)} reached")
    return _card(rows)


def note_card(note: str, pace: str) -> str:
    """Return what the visitor should know, and how fast it goes."""
    rows = [f'<div style="color:#f0a34a">{escape(note)}</div>'] if note else []
    return _card([*rows, f'<span style="{FAINT}">{escape(pace)}</span>'])


def _card(rows: Iterable[str]) -> str:
    style = "padding:0.3em 0.9em;font-size:0.85rem;line-height:1.5"
    return f'<div style="{style};overflow-wrap:anywhere">{"".join(rows)}</div>'


def _row(title: str, text: str) -> str:
    return f'<div><span style="{FAINT}">{title}</span> {text}</div>'


def _chip(text: str, color: str) -> str:
    style = f"background:{color}33;border:1px solid {color};border-radius:1em"
    return f'<span style="{style};padding:0.05em 0.7em">{text}</span>'
