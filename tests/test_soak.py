"""Stepping for long holds on to nothing; a leak would be seen."""

import os
import subprocess
import sys

import pytest
import soak
from soak import SAMPLES, Usage

FLAT = [Usage(400_000_000, 20, 3)] * SAMPLES


def growing(**a_sample):
    """Return usages that grow by so much with every sample."""
    return [
        Usage(**{k: v + i * a_sample.get(k, 0) for k, v in vars(FLAT[0]).items()})
        for i in range(SAMPLES)
    ]


def test_what_grows_is_named():
    assert soak.leaks(FLAT) == []
    assert soak.leaks(growing(memory=400_000)) == []  # 2% from first to last quarter
    assert "memory: " in soak.leaks(growing(memory=1_600_000))[0]
    assert soak.leaks(growing(files=1)) == ["files: 36 grew to 69"]
    assert soak.leaks(growing(processes=1)) == ["processes: 19 grew to 52"]


def test_growth_while_warming_up_is_no_leak():
    warming = [Usage(1_000_000, 1, 1)] * (SAMPLES // 3)
    assert soak.leaks([*warming, *FLAT[len(warming) :]]) == []


@pytest.mark.slow
@pytest.mark.parametrize(("num_envs", "steps"), [(1, 2500), (4, 650)])
def test_memory_files_and_processes_stay_flat(num_envs, steps):
    command = [sys.executable, soak.__file__, "--steps", str(steps)]
    done = subprocess.run(
        [*command, "--envs", str(num_envs)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith(f"{num_envs} envs: flat\n")
