"""The pages' code and commands work, links lead somewhere, all public is documented."""

import doctest
import importlib.util
import os
import pkgutil
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pdoc
import pytest
from test_examples import TINY, run
from test_nao_urdf import official

import ir_maniskill
from ir_maniskill import cli

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted(ROOT.glob("docs/*.md"))]

# -- All pages -------------------------------------------------------------------------

COMMAND = re.compile(r"^(?: {4}|.*--no-python |.*bin/|)ir-maniskill (.+)$", re.M)
"""A line of code that calls the program: what it is told."""


def headings(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub names them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", t.lower()).replace(" ", "-") for t in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\((?!http)([^)]+)\)", page.read_text())
    for file, _, anchor in (link.partition("#") for link in links):
        target = page.parent / file if file else page
        assert target.exists(), file
        assert not anchor or anchor in headings(target), anchor


def test_the_commands_of_the_pages_are_understood() -> None:
    text = "\n".join(page.read_text() for page in PAGES).replace("\\\n", "")
    commands = COMMAND.findall(text)
    assert len(commands) > 10
    for command in commands:
        try:
            cli.parse(shlex.split(command, comments=True))
        except SystemExit:
            pytest.fail(f"got ir-maniskill {command}, expected what it understands")


@pytest.mark.render
@pytest.mark.slow
def test_the_code_of_short_pages_runs(tmp_path: Path) -> None:
    pages = README.read_text() + (ROOT / "docs" / "other_tools.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", pages, re.M | re.S)
    play, task, left_hand, other = blocks
    assert run(tmp_path, "-c", play).endswith("tensor([True])\n")
    run(tmp_path, "-c", left_hand)
    (tmp_path / "snack.py").write_text(task)
    make = "import gymnasium as gym; gym.make('snack:Snack-v1', obs_mode='state')"
    run(tmp_path, "-c", make)
    if importlib.util.find_spec("stable_baselines3"):
        here = f"import sys; sys.path.append({str(ROOT)!r})\n"
        run(tmp_path, "-c", here + other.replace("20_000", "110"))


def test_the_readme_is_short() -> None:
    assert len(README.read_bytes()) <= 9000


# -- The tutorial ----------------------------------------------------------------------

TUTORIAL = (ROOT / "docs" / "tutorial.md").read_text()
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", TUTORIAL, re.M | re.S)
BUDGET = {"total_steps=60_000": "total_steps=64", "episodes=40": "episodes=2"}
"""What takes minutes, and what takes seconds instead."""
THEIR_URDF = "/path/to/nao.urdf"


def shell(folder: Path, block: str) -> str:
    """Run commands as they stand, in a shell whose python trains and films little."""
    programs = folder / "bin"
    programs.mkdir(exist_ok=True)
    (programs / "tiny.py").write_text(TINY)
    python = f'exec {sys.executable} -W ignore -c "$(cat {programs}/tiny.py)" "$@"'
    (programs / "python").write_text(f"#!/bin/sh\n{python}\n")
    (programs / "python").chmod(0o755)
    path = [str(programs), str(Path(sys.executable).parent), os.environ["PATH"]]
    done = subprocess.run(
        ["sh", "-eu", "-c", block],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PATH": os.pathsep.join(path)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.render
@pytest.mark.slow
def test_every_block_of_the_tutorial_runs_in_order(tmp_path: Path) -> None:
    changes = {**BUDGET, THEIR_URDF: str(official(tmp_path / "ros"))}
    assert all(old in TUTORIAL for old in changes)
    said = "nothing yet"
    for language, text in BLOCKS:
        for old, new in changes.items():
            text = text.replace(old, new)
        if language == "python":
            (tmp_path / re.match(r"# (\w+\.py)\n", text)[1]).write_text(text)
        elif language == "sh":
            said = shell(tmp_path, text)
        else:
            assert language == "text"
            same = doctest.OutputChecker().check_output(text, said, doctest.ELLIPSIS)
            assert same, said
    for name in ("front.png", "fruit.mp4", "runs/fruit/learning_curve.png"):
        assert (tmp_path / name).stat().st_size > 1000


# -- Docstrings ------------------------------------------------------------------------

INSIDE = pkgutil.walk_packages(ir_maniskill.__path__, "ir_maniskill.")
MODULES = ["ir_maniskill", *(module.name for module in INSIDE)]


def silent(doc: pdoc.doc.Doc) -> list[str]:
    """Return the names of what has no docstring, of `doc` and all defined in it."""
    mute = [] if doc.docstring.strip() else [doc.fullname]
    members = doc.members.values() if isinstance(doc, pdoc.doc.Namespace) else ()
    for member in members:
        speaks = isinstance(member, pdoc.doc.Class | pdoc.doc.Function)
        ours = member.taken_from[0] == doc.modulename
        if speaks and ours and not member.name.startswith("_"):
            mute += silent(member)
    return mute


def test_all_that_is_public_has_a_docstring() -> None:
    for name in ("tasks.single", "assets.nao.build", "environment.robots.nao"):
        assert f"ir_maniskill.{name}" in MODULES
    mute = [n for m in MODULES for n in silent(pdoc.doc.Module.from_name(m))]
    assert mute == []


def test_the_citation_is_of_this_version() -> None:
    assert (
        f"\nversion: {ir_maniskill.__version__}\n"
        in (ROOT / "CITATION.cff").read_text()
    )
