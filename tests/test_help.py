"""What is asked most is told at once, and of what there is."""

import io
import re
import subprocess
import sys

import pytest

import ir_maniskill_cli
from ir_maniskill import cli

TASK = "NaoTouchCubeSingle-v1"


def commands(capsys) -> set[str]:
    """Return the commands that there are, as an error lists them."""
    with pytest.raises(SystemExit):
        cli.parse(["--help"])
    return set(re.findall(r"\{(.+)\}", capsys.readouterr().out)[0].split(","))


def test_the_overview_lists_every_command(capsys):
    listed = re.findall(r"^  (\w+)  ", ir_maniskill_cli.OVERVIEW, re.M)
    assert set(listed) == commands(capsys) and len(listed) == len(set(listed))


def test_the_help_of_train_is_short_and_true():
    lines = ir_maniskill_cli.TRAIN.splitlines()
    assert len(lines) <= 48 and max(map(len, lines)) <= 80
    options = re.findall(
        r"^  (--[\w.-]+)(?: [A-Z]+)* {2,}", ir_maniskill_cli.TRAIN, re.M
    )
    assert len(options) == 12 and options.pop() == "--help-all"
    values = {"--preset": "paper", "--sim-backend": "physx_cuda"}
    values |= {"--robot": "g1", "--agent.senses": "proprioception"}
    values |= {"--init-from": TASK}
    for option in options:
        value = [] if option == "--resume" else [values.get(option, "3")]
        cli.parse(["train", TASK, option, *value, "--out", "/nowhere"])


@pytest.mark.parametrize(
    ("told", "code", "said"),
    [
        (["--help"], 0, ir_maniskill_cli.OVERVIEW),
        (["train", "--help"], 0, ir_maniskill_cli.TRAIN),
        (["train", TASK, "-h"], 0, ir_maniskill_cli.TRAIN),
        ([], 2, ""),
    ],
)
def test_help_is_told_with_the_right_exit_code(told, code, said, capsys):
    with pytest.raises(SystemExit) as stop:
        ir_maniskill_cli.main(told)
    assert (stop.value.code or 0) == code and capsys.readouterr().out == said


def test_help_imports_no_simulator():
    ask = "import ir_maniskill_cli, atexit, sys; "
    ask += "atexit.register(lambda: print(len(sys.modules), 'torch' in sys.modules)); "
    ask += "ir_maniskill_cli.main(['train', '--help'])"
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True)
    count, torch = done.stdout.split()[-2:]
    assert (torch, int(count) < 300) == ("False", True)


@pytest.mark.parametrize("told", [["evaluate", "-h"], ["train", TASK, "--help-all"]])
def test_the_rest_is_told_by_the_parser_itself(told, capsys):
    with pytest.raises(SystemExit) as stop:
        ir_maniskill_cli.main(told)
    assert stop.value.code == 0
    assert "--seed INT" in capsys.readouterr().out


def ascii_stream() -> io.TextIOWrapper:
    """Return what a terminal is that knows ASCII alone."""
    return io.TextIOWrapper(io.BytesIO(), encoding="ascii")


def test_a_terminal_that_knows_ascii_alone_is_told_all(monkeypatch):
    text = "Würfel • 触摸"
    out, errors = ascii_stream(), ascii_stream()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", errors)
    ir_maniskill_cli.OVERVIEW.encode("ascii")
    ir_maniskill_cli.TRAIN.encode("ascii")
    monkeypatch.setattr(cli, "run", lambda arguments: print(text) or 0)
    with pytest.raises(SystemExit) as stop:
        cli.main([text])
    assert stop.value.code == 0
    out.flush()
    said = out.buffer.getvalue().decode("ascii").strip()
    assert said.encode("ascii").decode("unicode_escape") == text
