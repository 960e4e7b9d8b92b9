import json
import subprocess
import sys
from pathlib import Path

import pytest

from ir_maniskill import doctor

DEBIAN_12 = {"ID": "debian", "VERSION_ID": "12", "PRETTY_NAME": "Debian 12"}
DEB822 = """\
# a comment
Types: deb
URIs: http://mirror.example/debian
Suites: bookworm bookworm-updates
Components: main contrib
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg

Types: deb
URIs: http://mirror.example/security
Suites: bookworm-security
Components: main
"""


@pytest.fixture
def apt(tmp_path):
    (tmp_path / "sources.list.d").mkdir()
    return tmp_path


@pytest.fixture
def broken(monkeypatch):
    """A machine whose render probe fails."""
    report = {"error": "RuntimeError: failed to find a rendering device"}
    monkeypatch.setattr(doctor, "_run_probe", lambda: report)


@pytest.mark.render
def test_this_machine_renders_and_says_through_what():
    diagnosis = doctor.diagnose()
    assert diagnosis.healthy, diagnosis.render_error
    assert diagnosis.render_device and diagnosis.remedy == ()
    assert "works, through" in str(diagnosis)
    assert diagnosis.packages["sapien"].startswith("3.")


def test_without_a_driver_the_probe_reports_it_and_the_exit_code_is_1():
    """Run as the set-up does: as a file, importing nothing of the package."""
    done = subprocess.run(
        [sys.executable, "-I", doctor.__file__, "--json"],
        env={"VK_ICD_FILENAMES": "/nowhere", "VK_DRIVER_FILES": "/nowhere", "PATH": ""},
        capture_output=True,
        text=True,
        timeout=120,
    )
    data = json.loads(done.stdout)
    assert done.returncode == 1 and data["healthy"] is False
    assert "rendering device" in data["render_error"]
    assert data["remedy"] or data["advice"]


def test_a_crashing_probe_is_reported_not_suffered(monkeypatch):
    monkeypatch.setattr(doctor, "_PROBE", "import os; os.abort()")
    diagnosis = doctor.diagnose()
    assert not diagnosis.healthy
    assert "ended with code -6" in diagnosis.render_error


def test_a_hanging_probe_is_given_up(monkeypatch):
    monkeypatch.setattr(doctor, "_PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(doctor, "PROBE_TIMEOUT", 0.5)
    assert "longer than 0.5 s" in doctor.diagnose().render_error


def test_debian_12_gets_backports_copied_from_its_own_entry(apt):
    (apt / "sources.list.d" / "debian.sources").write_text(DEB822)
    commands, advice = doctor.prescribe(DEBIAN_12, apt, gpu=False)
    script = "\n".join(commands)
    assert advice is None
    assert f"{apt}/sources.list.d/bookworm-backports.sources" in script
    assert "URIs: http://mirror.example/debian\nSuites: bookworm-backports\n" in script
    assert "Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg" in script
    assert "security" not in script
    assert "-t bookworm-backports mesa-vulkan-drivers libvulkan1" in script


def test_debian_12_reads_the_older_format_too(apt):
    line = "deb [arch=amd64 signed-by=/k.gpg] http://old.example/debian bookworm main\n"
    (apt / "sources.list").write_text("# deb http://no bookworm main\n" + line)
    commands, _ = doctor.prescribe(DEBIAN_12, apt, gpu=False)
    script = "\n".join(commands)
    assert "URIs: http://old.example/debian" in script and "Signed-By: /k.gpg" in script


def test_debian_12_with_backports_does_not_get_them_twice(apt):
    text = DEB822.replace("bookworm-security", "bookworm-backports")
    (apt / "sources.list.d" / "debian.sources").write_text(text)
    commands, _ = doctor.prescribe(DEBIAN_12, apt, gpu=False)
    assert len(commands) == 2 and "-t bookworm-backports" in commands[1]


@pytest.mark.parametrize("release", [("ubuntu", "24.04"), ("debian", "13")])
def test_newer_systems_need_no_other_suite(release, apt):
    commands, advice = doctor.prescribe(
        {"ID": release[0], "VERSION_ID": release[1]}, apt, gpu=False
    )
    assert advice is None and " -t " not in commands[1]
    assert "mesa-vulkan-drivers libvulkan1" in commands[1]


@pytest.mark.parametrize("release", [("ubuntu", "22.04"), ("fedora", "41"), ("", "")])
def test_unknown_systems_get_advice_and_no_commands(release, apt):
    commands, advice = doctor.prescribe(
        {"ID": release[0], "VERSION_ID": release[1]}, apt, gpu=False
    )
    assert commands == () and "24.3" in advice


def test_an_nvidia_driver_without_vulkan_gets_its_own_advice(apt):
    commands, advice = doctor.prescribe(DEBIAN_12, apt, gpu=True)
    assert commands == () and "NVIDIA_DRIVER_CAPABILITIES" in advice


def test_commands_option_prints_a_script_that_bash_accepts(broken, monkeypatch, capsys):
    monkeypatch.setattr(doctor, "read_os_release", lambda: DEBIAN_12)
    monkeypatch.setattr(doctor, "has_nvidia_driver", lambda: False)
    assert doctor.main(["--commands"]) == 1
    script = capsys.readouterr().out
    assert "apt-get install" in script
    assert subprocess.run(["bash", "-n", "-c", script]).returncode == 0


def test_require_vulkan_is_silent_where_rendering_works():
    doctor.require_vulkan()


def test_require_vulkan_says_what_to_install(monkeypatch):
    import sapien

    def fail():
        raise RuntimeError("failed to find a rendering device")

    monkeypatch.setattr(sapien.render, "get_device_summary", fail)
    monkeypatch.setattr(doctor, "read_os_release", lambda: DEBIAN_12)
    monkeypatch.setattr(doctor, "has_nvidia_driver", lambda: False)
    with pytest.raises(RuntimeError, match="render_backend='none'.*\n.*apt-get"):
        doctor.require_vulkan()


def test_os_release_is_read_with_and_without_quotes(tmp_path):
    path = tmp_path / "os-release"
    path.write_text('ID=debian\nVERSION_ID="12"\n\nPRETTY_NAME="Debian 12"\n')
    assert doctor.read_os_release(path) == DEBIAN_12
    assert doctor.read_os_release(Path("/nowhere")) == {}
