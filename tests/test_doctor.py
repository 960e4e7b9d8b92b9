import subprocess
import sys

import pytest

from ir_maniskill import doctor

DEBIAN_12 = {"ID": "debian", "VERSION_ID": "12", "PRETTY_NAME": "Debian 12"}


@pytest.fixture(autouse=True)
def no_gpu(monkeypatch):
    """A machine without an NVIDIA driver, whatever this one has."""
    monkeypatch.setattr(doctor, "has_nvidia_driver", lambda: False)


@pytest.fixture
def broken(monkeypatch):
    """A machine whose render probe fails."""
    report = {"error": "RuntimeError: failed to find a rendering device"}
    monkeypatch.setattr(doctor, "_run_probe", lambda: report)


@pytest.mark.render
@pytest.mark.slow
def test_this_machine_renders_and_says_through_what():
    diagnosis = doctor.diagnose()
    assert diagnosis.healthy, diagnosis.render_error
    assert diagnosis.render_device and diagnosis.remedy == ()
    assert "works, through" in str(diagnosis)
    assert diagnosis.facts["sapien"].startswith("3.")


def test_without_a_driver_the_probe_reports_it_and_the_exit_code_is_1():
    """Run as the set-up does: as a file, importing nothing of the package."""
    done = subprocess.run(
        [sys.executable, "-I", doctor.__file__],
        env={"VK_ICD_FILENAMES": "/nowhere", "VK_DRIVER_FILES": "/nowhere", "PATH": ""},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1
    assert "FAILS" in done.stdout and "rendering device" in done.stdout
    assert "mesa-vulkan-drivers" in done.stdout or "Vulkan driver" in done.stdout


def test_a_crashing_probe_is_reported_not_suffered(monkeypatch):
    monkeypatch.setattr(doctor, "_PROBE", "import os; os.abort()")
    diagnosis = doctor.diagnose()
    assert not diagnosis.healthy
    assert "ended with code -6" in diagnosis.render_error


def test_a_torch_that_cannot_be_imported_is_told(monkeypatch):
    broken = doctor._PROBE.replace("import torch", "import torch_of_nobody")
    monkeypatch.setattr(doctor, "_PROBE", broken)
    diagnosis = doctor.diagnose()
    assert diagnosis.facts["CUDA"].startswith("FAILS: ModuleNotFoundError")
    assert not diagnosis.healthy


def test_a_hanging_probe_is_given_up(monkeypatch):
    monkeypatch.setattr(doctor, "_PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(doctor, "PROBE_TIMEOUT", 0.5)
    assert "longer than 0.5 s" in doctor.diagnose().render_error


def test_debian_12_installs_from_backports():
    (add, update, install), advice = doctor.prescribe(DEBIAN_12)
    assert advice is None and "apt-get update" in update
    assert "bookworm-backports main' | " in add
    assert add.endswith("tee /etc/apt/sources.list.d/bookworm-backports.list")
    assert "-t bookworm-backports mesa-vulkan-drivers libvulkan1" in install


@pytest.mark.parametrize("release", ["ubuntu 24.04", "ubuntu 26.04", "debian 13"])
def test_newer_systems_need_no_other_suite(release):
    system, version = release.split()
    commands, advice = doctor.prescribe({"ID": system, "VERSION_ID": version})
    assert advice is None and " -t " not in commands[1]
    assert "mesa-vulkan-drivers libvulkan1" in commands[1]


def test_missing_packages_come_before_drivers(broken, monkeypatch):
    monkeypatch.setattr(doctor, "_version", lambda name: None)
    diagnosis = doctor.diagnose()
    assert not diagnosis.healthy and diagnosis.remedy == ()
    assert "pip install -e ." in str(diagnosis) and "apt-get" not in str(diagnosis)


@pytest.mark.parametrize("release", ["ubuntu 22.04", "debian ", "fedora 41", " "])
def test_unknown_systems_get_advice_and_no_commands(release):
    system, version = release.split(" ")
    commands, advice = doctor.prescribe({"ID": system, "VERSION_ID": version})
    assert commands == () and "24.3" in advice


def test_an_nvidia_driver_without_vulkan_gets_its_own_advice(monkeypatch):
    monkeypatch.setattr(doctor, "has_nvidia_driver", lambda: True)
    commands, advice = doctor.prescribe(DEBIAN_12)
    assert commands == () and "NVIDIA_DRIVER_CAPABILITIES" in advice


def test_commands_option_prints_a_script_that_bash_accepts(broken, monkeypatch, capsys):
    monkeypatch.setattr(doctor, "os_release", lambda: DEBIAN_12)
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
    monkeypatch.setattr(doctor, "os_release", lambda: DEBIAN_12)
    with pytest.raises(
        RuntimeError, match="(?s)render_backend='none'.*apt-get install"
    ):
        doctor.require_vulkan()
