from types import SimpleNamespace

import pytest
import torch

from ir_maniskill.training import replay as module
from ir_maniskill.training.replay import Replay


def episode(first, count):
    """Return an episode whose rows are numbered from `first` on."""
    number = torch.arange(first, first + count)
    return {"number": number, "pair": torch.stack([number, -number], dim=1)}


def drawn(replay):
    """Return the numbers of the rows that are drawn, and of those that come next."""
    rows = replay.draw(300)
    after = replay.read("number", replay.after(rows)).tolist()
    return {*zip(replay.read("number", rows).tolist(), after, strict=True)}


def test_steps_are_drawn_of_every_row_but_the_last_of_an_episode(tmp_path) -> None:
    replay = Replay(20, tmp_path)
    replay.add(episode(0, 3))
    assert drawn(replay) == {(0, 1), (1, 2)}
    replay.add(episode(10, 2))
    assert drawn(replay) == {(0, 1), (1, 2), (10, 11)}


def test_the_oldest_rows_make_room_and_episodes_go_round_the_end(tmp_path) -> None:
    replay = Replay(7, tmp_path)
    for first in (0, 10, 20):  # 20, 21, 22 are in rows 6, 0, 1
        replay.add(episode(first, 3))
    # Of the first episode, rows 1 and 2 are left; they are of no use without 0.
    assert drawn(replay) == {(10, 11), (11, 12), (20, 21), (21, 22)}
    assert len(replay) == 7
    assert replay.bytes == 7 * 8 * (1 + 2 + 3)


def test_an_episode_fits_or_is_refused(tmp_path) -> None:
    with pytest.raises(ValueError, match="got an episode of 4 rows, room for 3"):
        Replay(3, tmp_path).add(episode(0, 4))


def test_stacks_begin_with_the_episode(tmp_path) -> None:
    replay = Replay(10, tmp_path)
    replay.add(episode(0, 3))
    replay.add(episode(10, 4))
    stacks = replay.read("number", torch.tensor([3, 4, 6]), frames=3)
    assert stacks.tolist() == [[10, 10, 10], [11, 10, 10], [13, 12, 11]]


def test_one_column_of_each_row_can_be_read(tmp_path) -> None:
    replay = Replay(10, tmp_path)
    replay.add(episode(1, 3))
    rows, column = torch.tensor([0, 2]), torch.tensor([1, 0])
    assert replay.read("pair", rows, column=column).tolist() == [-1, 3]


def test_what_was_kept_in_a_folder_is_there_for_the_next_process(tmp_path) -> None:
    first = Replay(8, tmp_path)
    first.add(episode(0, 4))
    state = first.state_dict()
    first.add(episode(10, 4))  # after the checkpoint: as if it had not been

    second = Replay(8, tmp_path)
    second.load_state_dict(state)
    assert len(second) == 4
    second.add(episode(20, 3))
    numbers = second.read("number", second.draw(300))
    assert set(numbers.tolist()) == {0, 1, 2, 20, 21}


def test_if_all_rows_are_later_than_the_checkpoint_it_begins_anew(tmp_path) -> None:
    first = Replay(8, tmp_path)
    first.add(episode(0, 4))
    state = first.state_dict()
    for begin in (10, 20):
        first.add(episode(begin, 4))

    second = Replay(8, tmp_path)
    second.load_state_dict(state)
    assert len(second) == 0
    second.add(episode(30, 4))
    assert set(second.read("number", second.draw(99)).tolist()) == {30, 31, 32}


def test_a_disk_that_is_full_is_an_error(tmp_path, monkeypatch) -> None:
    free = SimpleNamespace(free=1000)
    monkeypatch.setattr(module, "disk_usage", lambda folder: free)
    replay = Replay(100, tmp_path)  # of 48 bytes a row
    replay.add(episode(0, 10))
    with pytest.raises(OSError, match="cannot write .*No space left on device"):
        replay.add(episode(0, 11))


def test_rows_of_another_layout_are_refused(tmp_path) -> None:
    first = Replay(8, tmp_path)
    first.add(episode(0, 4))
    second = Replay(9, tmp_path)
    with pytest.raises(ValueError, match="got 8 rows, expected 9"):
        second.load_state_dict(first.state_dict())
