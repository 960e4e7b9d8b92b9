"""Says whether this machine can run the project, and what to install if not.

Rendering is what fails most: SAPIEN draws with Vulkan, and needs a driver even on a
machine without a GPU (Mesa's software driver, lavapipe, from version 24.3 on). This
file imports nothing but the standard library, so that it also runs where SAPIEN itself
cannot be imported: ``python -I ir_maniskill/doctor.py``.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

PROBE_TIMEOUT = 120.0
"""Longest the render probe may take [s]."""

PACKAGES = ("torch", "mani_skill", "sapien", "gymnasium", "numpy")
"""Distributions whose versions decide what works."""

SYSTEM_PACKAGES = (
    "mesa-vulkan-drivers",  # lavapipe, the software Vulkan driver
    "libvulkan1",  # the Vulkan loader
    "libx11-6",  # linked by SAPIEN
    "libgl1",  # linked by OpenCV, which SAPIEN requires
    "libglib2.0-0",  # the same
)
"""Debian's and Ubuntu's packages for rendering on the CPU."""

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
    report["physx"] = sapien.physx.version()
except Exception as error:
    report["error"] = f"{type(error).__name__}: {error}"
try:
    import torch
    if torch.cuda.is_available():
        report["cuda"] = torch.cuda.get_device_name(0)
except Exception as error:
    report["cuda_error"] = f"{type(error).__name__}: {error}"
print("PROBE" + json.dumps(report))
"""


@dataclass(frozen=True)
class Diagnosis:
    """What was found on this machine."""

    python: str
    """Version of the running Python."""
    platform: str
    """Operating system, from /etc/os-release where there is one."""
    packages: dict[str, str | None]
    """Installed version of each of PACKAGES; None where it is missing."""
    render_device: str | None
    """The Vulkan device that drew the test picture; None if none could."""
    software: bool
    """Whether that device is a software one (lavapipe)."""
    render_error: str | None
    """Why rendering failed; None if it works."""
    cuda_device: str | None
    """The CUDA device that torch sees; None without one."""
    physx_gpu: str | None
    """Path of SAPIEN's PhysX GPU library; None until SAPIEN has downloaded it."""
    remedy: tuple[str, ...]
    """Shell commands that should make rendering work; empty if it does."""
    advice: str | None
    """What to do where no command is known; None if not needed."""

    @property
    def healthy(self) -> bool:
        """Whether everything needed on the CPU is there."""
        return self.render_error is None and None not in self.packages.values()

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {**asdict(self), "healthy": self.healthy}

    def __str__(self) -> str:
        lines = [("Python", self.python), ("System", self.platform)]
        lines += [(k, v or "MISSING") for k, v in self.packages.items()]
        lines += [
            ("Rendering", _describe_rendering(self)),
            ("CUDA", self.cuda_device or "none (the CPU does everything)"),
            ("PhysX on GPU", self.physx_gpu or "not downloaded (only CUDA needs it)"),
        ]
        text = "\n".join(f"{name:<13} {value}" for name, value in lines)
        if self.advice:
            text += f"\n\n{self.advice}"
        if self.remedy:
            text += "\n\nTo render here, run:\n\n" + "\n".join(self.remedy)
        return text


def diagnose() -> Diagnosis:
    """Examine this machine; the render probe runs in a process of its own.

    A broken driver can end the process that asks it for a picture, hence the process.
    """
    probe = _run_probe()
    error = probe.get("error")
    if error is None and not probe.get("drawn"):
        error = "the test picture came out blank"
    device = None if error else _device_name(probe.get("summary", ""))
    release = read_os_release()
    remedy, advice = ((), None) if error is None else prescribe(release)
    return Diagnosis(
        python=platform.python_version(),
        platform=release.get("PRETTY_NAME", platform.platform()),
        packages={name: _version(name) for name in PACKAGES},
        render_device=device,
        software=device is not None and _is_software(device),
        render_error=error,
        cuda_device=probe.get("cuda"),
        physx_gpu=_physx_gpu_library(probe.get("physx")),
        remedy=remedy,
        advice=advice,
    )


def require_vulkan() -> None:
    """Raise one clear error if SAPIEN finds no Vulkan device to render with.

    Cheap where there is one: it asks SAPIEN in this process.

    Raises:
        RuntimeError: No device; the message holds the commands that install one.
    """
    import sapien

    try:
        sapien.render.get_device_summary()
    except RuntimeError as error:
        remedy, advice = prescribe(read_os_release())
        todo = "\n".join(filter(None, (advice, *remedy)))
        raise RuntimeError(
            f"SAPIEN cannot render here: got '{error}'; expected a Vulkan device "
            "(a GPU's, or Mesa's lavapipe from 24.3 on). `ir-maniskill doctor` tells "
            "more. To go without pictures, make the env with render_backend='none' and "
            f"obs_mode 'state' or 'state_dict'. To render:\n{todo}"
        ) from error


def read_os_release(path: Path = Path("/etc/os-release")) -> dict[str, str]:
    """Read the distribution's name and version; empty where the file is missing."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError:
        return {}
    pairs = (line.partition("=") for line in text.splitlines() if "=" in line)
    return {key: value.strip("\"'") for key, _, value in pairs}


def prescribe(
    release: dict[str, str], apt: Path = Path("/etc/apt"), gpu: bool | None = None
) -> tuple[tuple[str, ...], str | None]:
    """Find what makes rendering work on a distribution.

    Args:
        release: The distribution, as read by `read_os_release`.
        apt: Folder of apt's configuration, where Debian's server is looked up.
        gpu: Whether an NVIDIA driver is there; looked up by default.

    Returns:
        The shell commands to run, and advice in words where commands don't suffice.
    """
    if has_nvidia_driver() if gpu is None else gpu:
        return (), (
            "An NVIDIA driver is here, but not its Vulkan part. Install the driver's "
            "graphics libraries (libnvidia-gl-...); in a container set "
            "NVIDIA_DRIVER_CAPABILITIES=all. To render on the CPU instead, install "
            "mesa-vulkan-drivers (24.3 or newer) and set "
            "VK_ICD_FILENAMES=/usr/share/vulkan/icd.d/lvp_icd.json."
        )
    distribution = release.get("ID", "")
    version = _as_number(release.get("VERSION_ID", ""))
    if distribution == "debian" and version == 12:
        return _debian_12_commands(apt)
    if (distribution == "debian" and version > 12) or (
        distribution == "ubuntu" and version >= 24.04
    ):
        return _apt_commands(), None
    return (), (
        f"No recipe for {release.get('PRETTY_NAME', 'this system')}: install a Vulkan "
        "driver (for the CPU: Mesa's lavapipe, 24.3 or newer), the Vulkan loader, "
        "libX11, libGL and GLib. Debian 12 and Ubuntu 24.04 or later are known to work."
    )


def has_nvidia_driver() -> bool:
    """Return whether nvidia-smi is there and works."""
    command = shutil.which("nvidia-smi")
    if command is None:
        return False
    try:
        return (
            subprocess.run([command], capture_output=True, timeout=30).returncode == 0
        )
    except (OSError, subprocess.TimeoutExpired):
        return False


def _apt_commands(suite: str | None = None) -> tuple[str, ...]:
    """Commands that install SYSTEM_PACKAGES, from a suite if one is named."""
    sudo = "" if os.geteuid() == 0 else "sudo "
    target = f"-t {suite} " if suite else ""
    names = " ".join(SYSTEM_PACKAGES)
    return (
        f"{sudo}apt-get update",
        f"{sudo}apt-get install -y --no-install-recommends {target}{names}",
    )


def _debian_12_commands(apt: Path) -> tuple[tuple[str, ...], str | None]:
    """Commands for Debian 12, whose own Mesa (22.3) is too old for SAPIEN.

    The backports suite lies on the same server as the main one, so its address and
    key are taken from the existing entry.
    """
    suite = "bookworm-backports"
    entries = _read_apt_entries(apt)
    if any(suite in entry["Suites"].split() for entry in entries):
        return _apt_commands(suite), None
    main = next((e for e in entries if "bookworm" in e["Suites"].split()), None)
    if main is None:
        return _apt_commands(suite), (
            "Debian 12's own Mesa is too old: first add the suite bookworm-backports "
            "to apt's sources (no entry for bookworm was found to copy)."
        )
    source = {**main, "Suites": suite, "Components": "main"}
    sudo = "" if os.geteuid() == 0 else "sudo "
    write = (
        f"{sudo}tee {apt}/sources.list.d/{suite}.sources >/dev/null <<'END'",
        *(f"{key}: {value}" for key, value in source.items()),
        "END",
    )
    return write + _apt_commands(suite), None


def _read_apt_entries(apt: Path) -> list[dict[str, str]]:
    """Read apt's binary package sources, in both of its formats."""
    entries = []
    for path in sorted(apt.glob("sources.list.d/*.sources")):
        for stanza in re.split(r"\n\s*\n", path.read_text(encoding="utf-8")):
            entries.append(_parse_stanza(stanza))
    lists = [apt / "sources.list", *sorted(apt.glob("sources.list.d/*.list"))]
    for path in filter(Path.is_file, lists):
        entries += map(_parse_line, path.read_text(encoding="utf-8").splitlines())
    wanted = ("Types", "URIs", "Suites")
    return [e for e in entries if e and all(e.get(k) for k in wanted)]


def _parse_stanza(stanza: str) -> dict[str, str]:
    """Read one deb822 stanza, keeping the fields that say where packages are."""
    fields = ("Types", "URIs", "Suites", "Components", "Signed-By")
    pairs = (line.partition(":") for line in stanza.splitlines())
    found = {k: v.strip() for k, _, v in pairs if k in fields and v.strip()}
    return found if "deb" in found.get("Types", "").split() else {}


def _parse_line(line: str) -> dict[str, str]:
    """Read one line of the older format: deb [options] URI suite components."""
    match = re.match(r"deb\s+(?:\[(.*?)\]\s+)?(\S+)\s+(\S+)\s+(.+)", line.strip())
    if match is None:
        return {}
    options, uri, suite, components = match.groups()
    key = re.search(r"signed-by=(\S+)", options or "")
    entry = {"Types": "deb", "URIs": uri, "Suites": suite, "Components": components}
    return {**entry, "Signed-By": key.group(1)} if key else entry


def _run_probe() -> dict[str, Any]:
    """Draw a test picture in a process of its own and return its report."""
    command = [sys.executable, "-W", "ignore", "-c", _PROBE]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=PROBE_TIMEOUT
        )
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


def _is_software(device: str) -> bool:
    return any(
        word in device.lower() for word in ("llvmpipe", "lavapipe", "swiftshader")
    )


def _describe_rendering(diagnosis: Diagnosis) -> str:
    if diagnosis.render_error:
        return f"FAILS: {diagnosis.render_error}"
    kind = "software, on the CPU" if diagnosis.software else "hardware"
    return f"works, through {diagnosis.render_device} ({kind})"


def _physx_gpu_library(version: str | None) -> str | None:
    """Return where SAPIEN keeps its PhysX GPU library, if it is there."""
    if version is None:
        return None
    path = Path.home() / ".sapien" / "physx" / version / "libPhysXGpu_64.so"
    return str(path) if path.exists() else None


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _as_number(version: str) -> float:
    match = re.match(r"\d+(\.\d+)?", version)
    return float(match.group()) if match else 0.0


def main(arguments: list[str] | None = None) -> int:
    """Print the diagnosis; return 0 if this machine can render, else 1."""
    parser = argparse.ArgumentParser(prog="doctor", description=diagnose.__doc__)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--quiet", action="store_true", help="only the exit code")
    parser.add_argument(
        "--commands", action="store_true", help="only the commands to run, if any"
    )
    options = parser.parse_args(arguments)
    diagnosis = diagnose()
    if options.commands:
        print("\n".join(diagnosis.remedy))
    elif options.json:
        print(json.dumps(diagnosis.as_dict(), indent=2))
    elif not options.quiet:
        print(diagnosis)
    return 0 if diagnosis.healthy else 1


if __name__ == "__main__":
    sys.exit(main())
