"""Stepping for long holds on to nothing."""

import statistics

import psutil
import pytest

EPISODES = 60
"""The first third warms up: caches fill, shaders are compiled."""


def usage() -> tuple[int, int, int]:
    """Return memory [byte], open files and processes, of this process and its own."""
    me = psutil.Process()
    family = [me, *me.children(recursive=True)]
    memory = sum(process.memory_info().rss for process in family)
    return memory, sum(process.num_fds() for process in family), len(family)


@pytest.mark.render
@pytest.mark.slow
@pytest.mark.parametrize("name", ["multi_env", "multi_vec"])
def test_memory_files_and_processes_stay_flat(name, request):
    envs = request.getfixturevalue(name)
    envs.action_space.seed(0)
    seen = []
    for episode in range(EPISODES):
        envs.reset(seed=episode if episode % 10 == 0 else None)  # a seed rebuilds
        for _ in range(32):
            envs.step(envs.action_space.sample())
        seen.append(usage())
    memory, files, processes = zip(*seen[EPISODES // 3 :], strict=True)
    assert statistics.median(memory[-10:]) < 1.05 * statistics.median(memory[:10])
    assert files[-1] <= files[0]
    assert processes[-1] <= processes[0]
