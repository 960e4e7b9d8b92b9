"""An audit takes away what it says, nothing else, and counts what happens."""

import contextlib
import dataclasses
from types import SimpleNamespace
from typing import ClassVar

import pytest
import torch
from gymnasium.spaces import Box, Dict

import ir_maniskill
from ir_maniskill import experiment as catalog
from ir_maniskill.environment.senses import read_text, text_of, tokens_of
from ir_maniskill.evaluation import audit as audits
from ir_maniskill.evaluation import plots
from ir_maniskill.evaluation.audit import AuditReport, Row, at_random, blind, controls
from ir_maniskill.evaluation.evaluate import Rate
from ir_maniskill.evaluation.scripted import NotScriptedError
from ir_maniskill.language.tokens import UNK
from ir_maniskill.training.checkpoint import MismatchError

TASK = catalog.get("NaoTouchCubeTriangle-v1")
TOKENS = tokens_of(TASK.sentences, TASK.vocabulary, TASK.max_tokens)
NAMES = {
    "black pictures": {"rgb"},
    "pictures of another env": {"rgb"},
    "no touch": {"touch"},
    "no joints": {"proprioception", "target"},
    "no sentence": {"instruction", "text"},
    "another sentence": {"instruction", "text"},
    "words spelt backwards": {"instruction", "text"},
}


def observation(told=0):
    """Return what two envs observe, the second told the first sentence."""
    rows = [told, 0]
    said = [TASK.sentences[row] for row in rows]
    picture = torch.stack([torch.full((4, 2, 3), v, dtype=torch.uint8) for v in (7, 9)])
    return {
        "agent": {"proprioception": torch.ones(2, 3), "target": torch.ones(2, 3)},
        "extra": {
            "touch": torch.ones(2, 6),
            "instruction": TOKENS[rows],
            "text": text_of(said, 64),
        },
        "sensor_data": {"top_camera": {"rgb": picture}},
    }


def space_of(tree):
    leaf = Box(0, 1, (1,))
    return Dict(
        {k: space_of(v) if isinstance(v, dict) else leaf for k, v in tree.items()}
    )


def leaves(tree):
    found = {}
    for name, value in tree.items():
        found |= leaves(value) if isinstance(value, dict) else {name: value}
    return found


def changed(name, obs):
    return controls(TASK, space_of(obs))[name](obs)


@pytest.mark.parametrize("name, taken", NAMES.items())
def test_a_control_changes_what_it_names_and_nothing_else(name, taken):
    before = leaves(observation(told=1))
    after = leaves(changed(name, observation(told=1)))
    assert after.keys() == before.keys()
    assert {k for k in before if not torch.equal(before[k], after[k])} == taken


def test_what_is_not_observed_cannot_be_taken():
    felt = space_of({"extra": {"touch": 0}})
    assert list(controls(TASK, felt)) == ["no touch"]
    assert controls(TASK, Box(0, 1, (9,))) == {}, "a flat vector has no parts"


@pytest.mark.parametrize("told, instead", [(0, 1), (1, 2), (2, 0)])
def test_another_sentence_is_never_the_true_one(told, instead):
    after = changed("another sentence", observation(told))["extra"]
    assert torch.equal(after["instruction"], TOKENS[[instead, 1]])
    assert read_text(after["text"])[0] == TASK.sentences[instead]


def test_another_sentence_has_another_goal():
    blue, red, _ = TASK.instructions
    same = dataclasses.replace(blue, text="Touch blue.")
    task = dataclasses.replace(TASK, id="Same-v1", instructions=(blue, same, red))
    tokens = tokens_of(task.sentences, task.vocabulary, task.max_tokens)
    change = controls(task, space_of(observation()))["another sentence"]
    for told, instead in enumerate((2, 2, 0)):
        after = change({"extra": {"instruction": tokens[[told]]}})["extra"]
        assert torch.equal(after["instruction"], tokens[[instead]])


def test_other_pictures_are_those_of_the_next_env():
    pictures = changed("pictures of another env", observation())["sensor_data"]
    assert pictures["top_camera"]["rgb"][:, 0, 0, 0].tolist() == [9, 7]


def test_words_spelt_backwards_are_unknown():
    after = changed("words spelt backwards", observation())["extra"]
    stop = TASK.vocabulary.index(".")
    assert after["instruction"][0].tolist() == [UNK, UNK, UNK, UNK, stop]
    assert read_text(after["text"])[0] == "hcuoT eht eulb .ebuc"


def test_a_task_of_one_sentence_has_no_other_to_give():
    single = catalog.get("NaoTouchCubeSingle-v1")
    assert "another sentence" not in controls(single, space_of(observation()))


class Rows(list):
    """Stands in for `play`: remembers what was played, and every second succeeds."""

    def __call__(self, player, envs, told, seeds, progress=False):
        self.append(([TASK.sentences.index(i.text) for i in told], list(seeds)))
        figures = torch.ones(len(told), 7, dtype=torch.float64)
        figures[:, :2] = 0
        figures[::2, :2] = 1
        return figures, [instruction.text for instruction in told]


def test_each_row_plays_the_same_episodes(monkeypatch, multi_vec, caplog):
    rows = Rows()
    monkeypatch.setattr(audits, "play", rows)
    monkeypatch.setattr(audits, "_scripted", lambda *a: rows(None, *a)[2:])
    keep = contextlib.nullcontext(multi_vec)
    monkeypatch.setattr(audits, "closing", lambda envs: keep)
    task = multi_vec.experiment
    report = audits.audit(None, task, lambda **_: multi_vec, episodes=6, seed=50)
    assert rows[:-1] == [([0, 1, 2, 0, 1, 2], list(range(50, 56)))] * (len(rows) - 1)
    assert rows[-1] == ([0, 0, 1, 1, 2, 2], [50, 51] * 3), "in two scenes, everything"
    by_name = {row.name: row for row in report.rows}
    assert by_name["the policy"].exclusive == Rate(3, 6)
    assert by_name["every sentence of a scene"].success == Rate(1, 2)
    assert by_name["one of its sentences"].success == Rate(3, 6)
    assert by_name[task.sentences[0]].success == Rate(1, 2)
    assert set(NAMES) <= set(by_name) and "take at least 100" in caplog.text


def test_what_is_not_scripted_has_no_row(monkeypatch, multi_vec, caplog):
    def fail(error):
        raise error

    alone = SimpleNamespace(
        base_env=NotScriptedError("goal: got Spin"), close=lambda: None
    )
    monkeypatch.setattr(audits, "blind", lambda *_: alone)
    monkeypatch.setattr(audits, "Scripted", fail)
    assert audits._scripted(multi_vec, [], []) == []
    assert "no scripted solution: goal: got Spin" in caplog.text
    alone.base_env = ValueError("a fault of ours")
    with pytest.raises(ValueError, match="a fault of ours"):
        audits._scripted(multi_vec, [], [])


def test_a_report_is_a_table_data_and_a_picture(tmp_path):
    rows = (Row("who", "the policy", Rate(8, 10), Rate(5, 10)),)
    report = AuditReport("Task-v1", 7, 10, rows)
    assert " 80.0% [49.0,  94.3]   50.0% [23.7,  76.3]" in str(report)
    data = report.as_dict()["rows"][0]
    assert (data["group"], data["success"], data["total"]) == ("who", 0.8, 10)
    assert plots.bars(report, tmp_path / "a.png").stat().st_size > 5000


def test_random_actions_are_always_alike(multi_vec):
    first, again = at_random(multi_vec)({}, None), at_random(multi_vec)({}, None)
    assert torch.equal(first, again) and first.shape == (2, 26)
    assert -1 <= first.min() < -0.8 and 0.8 < first.max() <= 1


def test_anybodys_function_is_audited_on_what_envs_observe(monkeypatch):
    asked = {}

    def fake(player, task, make, **kwargs):
        asked.update(kwargs, made=make.keywords, task=task.id)
        asked["action"] = player({"x": 1}, torch.tensor([True]))

    class Mine:
        env_kwargs: ClassVar = {"obs_mode": "state"}

        def act(self, obs):
            return [[obs["x"] + self.begun.sum().item()]]

        def reset(self, done):
            self.begun = done

    with pytest.raises(ValueError, match="episodes: got 1.5, expected a whole number"):
        ir_maniskill.audit(Mine(), TASK.id, episodes=1.5)
    monkeypatch.setattr(audits, "audit", fake)
    ir_maniskill.audit(Mine(), TASK.id, episodes=5)
    assert asked["action"].tolist() == [[2]] and asked["task"] == TASK.id
    assert asked["made"]["obs_mode"] == "state"
    for wrong in (1, "2"):
        with pytest.raises(ValueError, match=f"num_envs: got {wrong!r}, .* at least 2"):
            ir_maniskill.audit(Mine(), TASK.id, num_envs=wrong)
    with pytest.raises(ValueError, match="policy: got .*, expected a function"):
        ir_maniskill.audit(audits, TASK.id)
    with pytest.raises(ValueError, match="task: got None, expected an id"):
        ir_maniskill.audit(Mine())


def test_a_policy_is_not_audited_on_another_robot_or_one_split():
    with pytest.raises(MismatchError, match="robot: got 'nao', expected 'g1'"):
        ir_maniskill.audit(TASK.id, robot_uids="g1")
    with pytest.raises(ValueError, match="split: got 'pairs', expected none"):
        ir_maniskill.audit(TASK.id, split="pairs")


def test_several_sentences_are_true_of_one_spoken_scene():
    with contextlib.closing(blind(catalog.get("NaoInstructTouch-v1"))) as envs:
        told = list(audits._told_in_each(envs, [3, 4]))
        starts = {}
        for seed, instruction in told:
            envs.reset(seed=seed, options={"instruction": [instruction]})
            start = envs.base_env.snapshot().start
            assert torch.equal(starts.setdefault(seed, start), start)
    for seed in starts:
        goals = [i.goal for s, i in told if s == seed]
        assert 2 <= len(set(goals)) == len(goals) <= audits.SENTENCES
