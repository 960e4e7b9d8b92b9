"""Says whether this machine can run the project, and what to install if not.

Rendering is what fails most: SAPIEN draws with Vulkan, and needs a driver even on a
machine without a GPU (Mesa's software driver, lavapipe, from version 24.3 on). This
file imports nothing but the standard library, so that it also runs where SAPIEN itself
cannot be imported: ``python -I ir_maniskill/doctor.py``.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PROBE_TIMEOUT = 120.0
"""Longest the render probe may take [s]."""

PACKAGES = ("torch", "mani_skill", "sapien", "gymnasium", "numpy")
"""Distributions whose versions decide what works."""

SOFTWARE = ("llvmpipe", "lavapipe", "swiftshader")
"""What the names of devices that are no hardware contain."""

SYSTEM_PACKAGES = (
    "mesa-vulkan-drivers",  # lavapipe, the software Vulkan driver
    "libvulkan1",  # the Vulkan loader
    "libx11-6",  # linked by SAPIEN
    "libgl1",  # linked by OpenCV, which SAPIEN requires
    "libglib2.0-0",  # the same
)
"""Debian's and Ubuntu's packages for rendering on the CPU."""

BACKPORTS = (
    "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] "
    "http://deb.debian.org/debian bookworm-backports main"
)
"""Where Debian 12 has a Mesa that is new enough."""

PACKAGES_ADVICE = (
    "Python packages are missing here. Install them first: `make setup`, or "
    "`pip install -e .` in an environment of your own."
)

NVIDIA_ADVICE = (
    "An NVIDIA driver is here, but not its Vulkan part. Install the driver's graphics "
    "libraries (libnvidia-gl-...); in a container set NVIDIA_DRIVER_CAPABILITIES=all. "
    "To render on the CPU instead, install mesa-vulkan-drivers (24.3 or newer) and set "
    "VK_ICD_FILENAMES=/usr/share/vulkan/icd.d/lvp_icd.json. If a library is missing, "
    "install that: libx11-6, libgl1 or libglib2.0-0."
)

_PROBE = """
import json, sys
report = {}
try:
    import sapien
    report["summary"] = sapien.render.get_device_summary()
    scene = sapien.Scene()
    scene.set_ambient_light([1.0, 1.0, 1.0])
    camera = scene.add_camera("probe", 16, 16, 1.0, 0.01, 10.0)
    builder = scene.create_actor_builder()
    builder.add_box_visual(half_size=[0.4, 0.4, 0.4], material=[1.0, 0.0, 0.0])
    builder.initial_pose = sapien.Pose([1.0, 0.0, 0.0])
    builder.build_static()
    scene.update_render()
    camera.take_picture()
    picture = camera.get_picture("Color")
    report["drawn"] = bool(picture[8, 8, 0] > picture[8, 8, 1] + 0.1)
except Exception as error:
    report["error"] = f"{type(error).__name__}: {error}"
try:
    import torch
    if torch.cuda.is_available():
        report["cuda"] = torch.cuda.get_device_name(0)
except Exception as error:
    report["cuda"] = f"FAILS: {type(error).__name__}: {error}"
print("PROBE" + json.dumps(report))
"""


@dataclass(frozen=True)
class Diagnosis:
    """What was found on this machine."""

    facts: dict[str, str | None]
    """Versions and devices by name; None for a package that is missing."""
    render_device: str | None
    """The Vulkan device that drew the test picture; None if none could."""
    render_error: str | None
    """Why rendering failed; None if it works."""
    remedy: tuple[str, ...]
    """Shell commands that should make rendering work; empty if it does."""
    advice: str | None
    """What to do where no command is known; None if not needed."""

    @property
    def healthy(self) -> bool:
        """Whether everything needed on the CPU is there."""
        found = self.facts.values()
        broken = None in found or any(str(fact).startswith("FAILS") for fact in found)
        return self.render_error is None and not broken

    def __str__(self) -> str:
        device = self.render_device or ""
        kind = "software" if any(n in device.lower() for n in SOFTWARE) else "hardware"
        works = f"works, through {device} ({kind})"
        failed = f"FAILS: {self.render_error}"
        facts = {**self.facts, "Rendering": failed if self.render_error else works}
        text = "\n".join(f"{k:<13} {v or 'MISSING'}" for k, v in facts.items())
        if self.advice:
            text += f"\n\n{self.advice}"
        if self.remedy:
            text += "\n\nTo render here, run:\n\n" + "\n".join(self.remedy)
        return text


def diagnose() -> Diagnosis:
    """Examine this machine; the render probe runs in a process of its own.

    A broken driver can end the process that asks it for a picture, hence the process.
    """
    probe, release = _run_probe(), os_release()
    blank = None if probe.get("drawn") else "the test picture came out blank"
    error = probe.get("error", blank)
    physx = any(Path.home().glob(".sapien/physx/*/libPhysXGpu_64.so"))
    facts = {
        "Python": platform.python_version(),
        "System": release.get("PRETTY_NAME", platform.platform()),
        **{name: _version(name) for name in PACKAGES},
        "CUDA": probe.get("cuda", "none (the CPU does everything)"),
        "PhysX on GPU": "ready" if physx else "not downloaded (only CUDA needs it)",
    }
    device = None if error else _device_name(probe.get("summary", ""))
    remedy, advice = ((), None) if error is None else prescribe(release)
    if None in facts.values():
        remedy, advice = (), PACKAGES_ADVICE
    return Diagnosis(facts, device, error, remedy, advice)


def require_vulkan() -> None:
    """Raise one clear error if SAPIEN finds no Vulkan device; quick if there is one.

    Raises:
        RuntimeError: No device; the message holds the commands that install one.
    """
    import sapien

    try:
        sapien.render.get_device_summary()
    except RuntimeError as error:
        remedy, advice = prescribe(os_release())
        todo = advice or "\n".join(remedy)
        raise RuntimeError(
            f"SAPIEN cannot render here: got '{error}'; expected a Vulkan device "
            "(a GPU's, or Mesa's lavapipe from 24.3 on). `ir-maniskill doctor` tells "
            "more. To go without pictures, make the env with render_backend='none' and "
            f"obs_mode 'state' or 'state_dict'. To render:\n{todo}"
        ) from error


def os_release() -> dict[str, str]:
    """Return the distribution's name and version; empty where it tells none."""
    try:
        return platform.freedesktop_os_release()
    except OSError:
        return {}


def prescribe(release: dict[str, str]) -> tuple[tuple[str, ...], str | None]:
    """Find what makes rendering work on a distribution.

    Returns:
        The shell commands to run, or none and advice in words.
    """
    if has_nvidia_driver():
        return (), NVIDIA_ADVICE
    system, version = release.get("ID"), release.get("VERSION_ID", "")
    sudo = "" if os.geteuid() == 0 else "sudo "
    names = " ".join(SYSTEM_PACKAGES)
    update = f"{sudo}apt-get update"
    install = f"{sudo}apt-get install -y --no-install-recommends"
    if (system, version) == ("debian", "12"):  # its own Mesa, 22.3, is too old
        suite = "bookworm-backports"
        add = f"grep -rqs {suite} /etc/apt/sources.list* || echo '{BACKPORTS}' | "
        add += f"{sudo}tee /etc/apt/sources.list.d/{suite}.list"
        return (add, update, f"{install} -t {suite} {names}"), None
    oldest = {"debian": 13, "ubuntu": 24}.get(system or "")
    if oldest is not None and int(version.split(".")[0] or 0) >= oldest:
        return (update, f"{install} {names}"), None
    return (), (
        f"No recipe for {release.get('PRETTY_NAME', 'this system')}: install a Vulkan "
        "driver (for the CPU: Mesa's lavapipe, 24.3 or newer), the Vulkan loader, "
        "libX11, libGL and GLib. Debian 12 and Ubuntu 24.04 or later are known to work."
    )


def has_nvidia_driver() -> bool:
    """Return whether nvidia-smi is there and works."""
    try:
        done = subprocess.run(["nvidia-smi"], capture_output=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def _run_probe() -> dict[str, Any]:
    """Draw a test picture in a process of its own and return its report."""
    command = [sys.executable, "-W", "ignore", "-c", _PROBE]
    options: dict[str, Any] = {"capture_output": True, "text": True}
    try:
        done = subprocess.run(command, timeout=PROBE_TIMEOUT, **options)
    except subprocess.TimeoutExpired:
        return {"error": f"the render probe took longer than {PROBE_TIMEOUT:g} s"}
    for line in done.stdout.splitlines():
        if line.startswith("PROBE"):
            return json.loads(line.removeprefix("PROBE"))
    tail = (done.stderr.strip().splitlines() or ["no output"])[-1]
    return {"error": f"the render probe ended with code {done.returncode}: {tail}"}


def _device_name(summary: str) -> str:
    """Return the first supported device of SAPIEN's device summary."""
    for block in summary.split("GPU: ")[1:]:
        if re.search(r"Supported:\s*1", block):
            return block.splitlines()[0].strip()
    return "unnamed Vulkan device"


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def main(arguments: list[str]) -> int:
    """Print the diagnosis; return 0 if this machine can render, else 1.

    With `--commands` it prints only the shell commands to run.
    """
    diagnosis = diagnose()
    only = "--commands" in arguments
    print("\n".join(diagnosis.remedy) if only else diagnosis)
    return 0 if diagnosis.healthy else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
