"""The locked set of what is installed, and types for those who use it."""

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]


# -- The locked set --------------------------------------------------------------------

CUDA = ("cuda", "nvidia", "triton")
"""Beginnings of the names of what torch brings along, exactly pinned, for a GPU."""


def pins() -> dict[str, SpecifierSet]:
    """Return what constraints.txt pins."""
    found: dict[str, SpecifierSet] = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if not line.startswith("#"):
            pin = Requirement(line)
            if pin.marker is None or pin.marker.evaluate():
                name = canonicalize_name(pin.name)
                assert name not in found, f"{name} is pinned twice"
                found[name] = pin.specifier
    return found


def needed() -> list[tuple[str, Requirement]]:
    """Return all that this project's extra `dev` leads to: by whom, and what."""
    todo, seen = [Requirement("ir-maniskill[dev]")], set()
    found: list[tuple[str, Requirement]] = []
    while todo:
        parent = todo.pop()
        for extra in ("", *parent.extras):
            key = (canonicalize_name(parent.name), extra)
            if key in seen:
                continue
            seen.add(key)
            for line in metadata.requires(parent.name) or []:
                child = Requirement(line)
                cuda = parent.name == "torch" and child.name.startswith(CUDA)
                marker = child.marker
                if not cuda and (marker is None or marker.evaluate({"extra": extra})):
                    todo.append(child)
                    found.append((parent.name, child))
    return [(by, what) for by, what in found if what.name != "ir-maniskill"]


def test_everything_that_is_needed_is_pinned_as_installed() -> None:
    required = {canonicalize_name(what.name) for _, what in needed()}
    assert {"mani-skill", "torch", "stable-baselines3", "numpy", "pytest"} <= required
    pinned = pins()
    assert sorted(required - pinned.keys()) == []
    installed = {name: metadata.version(name) for name in required}
    assert [
        f"{name} {version}"
        for name, version in sorted(installed.items())
        if not pinned[name].contains(version, prereleases=True)
    ] == []


# -- Types -----------------------------------------------------------------------------

SCRIPT = """
import ir_maniskill
report = ir_maniskill.evaluate("NaoTouchCubeSingle-v1")
wrong: int = report
"""


@pytest.mark.slow
def test_a_script_elsewhere_sees_types(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    cache = str(ROOT / ".mypy_cache" / "elsewhere")
    command = [sys.executable, "-m", "mypy", "--cache-dir", cache, "script.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    errors = [line for line in done.stdout.splitlines() if ": error: " in line]
    assert len(errors) == 1 and "script.py:4: " in errors[0]
    assert 'expression has type "EvaluationReport"' in errors[0]
