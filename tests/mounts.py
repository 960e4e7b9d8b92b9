"""Small file systems for tests of full disks."""

import contextlib
import subprocess

import pytest


@contextlib.contextmanager
def disk(folder, options):
    """Mount a file system in memory, where this process may."""
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this process may not mount file systems")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)
