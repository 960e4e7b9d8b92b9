import contextlib
import json
import platform
from types import SimpleNamespace

import pytest
import torch

import ir_maniskill
from ir_maniskill import api
from ir_maniskill.evaluation import evaluate
from ir_maniskill.evaluation.audit import same_scene
from ir_maniskill.evaluation.evaluate import (
    EvaluationReport,
    Rate,
    evaluate_policy,
    player_of,
)
from ir_maniskill.goals import Instruction
from ir_maniskill.language import parse

STEPS = 4
SENTENCES = ("Touch the blue cube.", "Touch the red cube.")
TOLD = tuple(Instruction(text, parse(text)) for text in SENTENCES)


class ScriptedEnvs:
    """Stands in for a vector env: what happens follows from (seed, instruction).

    Instruction 0 is touched from step 2 on by seed % 3 fingers, and a wrong object by
    one finger in step 1 if the seed is odd. Instruction 1 is never touched.
    """

    device = torch.device("cpu")
    experiment = SimpleNamespace(
        id="Scripted-v1", sentences=SENTENCES, instructions=TOLD, max_tokens=10
    )

    def __init__(self, num_envs):
        self.num_envs, self.resets = num_envs, []

    def reset(self, *, seed=None, options=None):
        self.seed = torch.tensor(seed)
        self.told = torch.tensor([TOLD.index(i) for i in options["instruction"]])
        self.resets.append((seed, self.told.tolist()))
        self.t = 0
        self.once = torch.zeros(self.num_envs, dtype=torch.bool)
        self.wrong_once = torch.zeros(self.num_envs, dtype=torch.bool)
        return self._observe(), {}

    def step(self, action):
        assert action.shape == (self.num_envs, 26)
        self.t += 1
        right = (self.seed % 3) * (self.told == 0) * (self.t >= 2)
        wrong = (self.seed % 2) * (self.t == 1)
        self.once |= right > 0
        self.wrong_once |= wrong > 0
        info = {
            "success": right > 0,
            "right_fingers": right,
            "wrong_fingers": wrong,
            "success_once": self.once.clone(),
            "exclusive_success": self.once & ~self.wrong_once,
        }
        done = torch.full((self.num_envs,), self.t == STEPS)
        if done.all():
            # The new episode, begun in the same step, has touched nothing yet.
            fresh = {key: torch.zeros_like(value) for key, value in info.items()}
            info = {**fresh, "final_info": info, "_final_info": done}
        return self._observe(), (right > 0).float(), torch.zeros_like(done), done, info

    def _observe(self):
        n = self.num_envs
        return {
            "agent": {
                "proprioception": torch.zeros(n, 26),
                "target": torch.zeros(n, 26),
            },
            "extra": {
                "touch": torch.zeros(n, 6),
                "instruction": self.told[:, None],
            },
        }


def still(state):
    return torch.zeros(len(state["instruction"]), 26)


def scripted(num_envs, episodes=12, **kwargs):
    envs = ScriptedEnvs(num_envs)
    report = evaluate_policy(still, envs, episodes=episodes, seed=0, **kwargs)
    return report, envs


def test_wilson_interval_matches_hand_computed_values():
    # 8 of 10: center (0.8 + z^2/20) / (1 + z^2/10) with z = 1.96.
    low, high = Rate(8, 10).interval
    assert low == pytest.approx(0.4902, abs=1e-4)
    assert high == pytest.approx(0.9433, abs=1e-4)


def test_wilson_interval_stays_within_zero_and_one_and_is_never_empty():
    assert Rate(0, 20).interval[0] == 0 and Rate(0, 20).interval[1] > 0.1
    assert Rate(20, 20).interval[1] == 1 and Rate(20, 20).interval[0] < 0.9


def test_scores_are_those_worked_out_by_hand():
    report, _ = scripted(num_envs=4)
    # Even seeds 0, 2, ... 10 are told to touch blue; 0 and 6 touch with no finger,
    # 2 and 8 with two, 4 and 10 with one, in 3 of 4 steps. None errs: they are even.
    blue = report.instructions[SENTENCES[0]]
    assert (blue.success.count, blue.success.total) == (4, 6)
    assert blue.exclusive.count == 4
    assert blue.holding == pytest.approx(4 / 6 * 3 / 4)
    assert blue.right_fingers == pytest.approx((2 + 2 + 1 + 1) * 3 / (6 * 4))
    assert blue.wrong_fingers == 0
    assert blue.mean_return == pytest.approx(4 * 3 / 6)
    # Odd seeds touch a wrong object once, and red never.
    red = report.instructions[SENTENCES[1]]
    assert (red.success.count, red.holding) == (0, 0)
    assert red.wrong_fingers == pytest.approx(1 / 4)
    assert report.overall.success.value == pytest.approx(4 / 12)


def test_touching_a_wrong_object_first_is_no_exclusive_success():
    report, _ = scripted(num_envs=3, episodes=12, instructions=[0])
    # All 12 seeds are told blue; 0, 3, 6, 9 never touch; of the rest the odd ones err.
    assert report.overall.success.count == 8
    assert report.overall.exclusive.count == 4


@pytest.mark.parametrize("num_envs", [1, 3, 5, 7, 12, 16])
def test_scores_do_not_depend_on_the_number_of_envs(num_envs):
    expected, _ = scripted(num_envs=4)
    assert scripted(num_envs)[0] == expected


def test_episodes_have_pinned_seeds_and_instructions_in_turn():
    _, envs = scripted(num_envs=4, episodes=6)
    assert envs.resets[0] == ([0, 1, 2, 3], [0, 1, 0, 1])
    # Two are left; the other envs play the first episodes again, uncounted.
    assert envs.resets[1] == ([4, 5, 0, 1], [0, 1, 0, 1])


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"episodes": 1}, "got 1, expected at least 2"),
        ({"episodes": 0}, "expected at least"),
        (
            {"episodes": 4, "instructions": [2]},
            "got .2., expected an index from 0 to 1, one of .'Touch the blue",
        ),
        ({"episodes": 4, "instructions": []}, "expected at least one"),
    ],
)
def test_impossible_requests_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        scripted(num_envs=2, **kwargs)


def test_report_is_written_as_json_with_versions_and_machine(tmp_path):
    report, _ = scripted(num_envs=4)
    path = tmp_path / "deep" / "report.json"
    evaluate.write_report(path, report, checkpoint="best.safetensors")
    data = json.loads(path.read_text())
    assert data["overall"]["success"] == pytest.approx(4 / 12)
    assert data["instructions"][SENTENCES[1]]["success_interval"][0] == 0
    assert data["seed"] == 0 and data["checkpoint"] == "best.safetensors"
    assert data["versions"]["sapien"].startswith("3.") and data["machine"]["cpus"] >= 1
    assert data["machine"]["platform"] == f"{platform.system()} {platform.machine()}"


def test_figures_stand_under_their_titles_however_short_the_names_are():
    score = scripted(num_envs=4)[0].overall
    report = EvaluationReport("T-v1", 0, 12, {"hand": score, "push": score}, score)
    head, *rows = str(report).splitlines()
    assert len(rows) == 3
    assert all(row.index(" 12 ") + 2 == head.index("N ") for row in rows)


class ObedientEnvs(ScriptedEnvs):
    """Blue is touched alone where the seed is even, red where 3 does not divide it."""

    def step(self, action):
        obs, reward, terminated, done, info = super().step(action)
        obeyed = torch.where(self.told == 0, self.seed % 2 == 0, self.seed % 3 != 0)
        info.get("final_info", info)["exclusive_success"] = obeyed
        return obs, reward, terminated, done, info


def exclusive_in_scenes(envs, scenes, seed):
    rows = same_scene(player_of(still, 3), envs, scenes=scenes, seed=seed)
    return [row.exclusive for row in rows]


@pytest.mark.parametrize("num_envs", [1, 4, 9])
def test_a_scene_counts_if_every_sentence_is_obeyed_in_it(num_envs):
    envs = ObedientEnvs(num_envs)
    # Of the seeds 0 to 8 the even ones 2, 4 and 8 are no multiples of 3: both obeyed.
    # Blue is obeyed in 0, 2, 4, 6, 8 and red in 1, 2, 4, 5, 7, 8.
    assert exclusive_in_scenes(envs, 9, 0) == [Rate(3, 9), Rate(11, 18)]
    played = {pair for reset in envs.resets for pair in zip(*reset, strict=True)}
    assert played == {(seed, told) for seed in range(9) for told in (0, 1)}


def test_scenes_are_counted_one_by_one_and_not_on_average():
    # Seed 2 obeys both; seed 3 is odd and a multiple of 3 and obeys neither.
    assert exclusive_in_scenes(ObedientEnvs(2), 2, 2) == [Rate(1, 2), Rate(2, 4)]


def test_a_seeds_scene_is_the_same_whatever_is_told():
    envs = ir_maniskill.make_vec(
        "NaoTouchCubeShuffled-v1", 1, obs_mode="state_dict", render_backend="none"
    )
    with contextlib.closing(envs):
        starts = []
        for index in range(3):
            options = {"instruction": torch.tensor([index])}
            obs, _ = envs.reset(seed=7, options=options)
            starts.append((obs["agent"]["proprioception"], obs["extra"]))
    for joints, extra in starts[1:]:
        assert torch.equal(joints, starts[0][0])
        assert torch.equal(extra["object_position"], starts[0][1]["object_position"])
        assert not torch.equal(extra["target_object"], starts[0][1]["target_object"])


@pytest.mark.render
def test_real_scores_are_equal_in_any_order_and_company(multi_vec, reflex):
    """The same episodes, two at a time, after others or not, end exactly alike."""

    def run(seed, episodes):
        return evaluate_policy(
            reflex, multi_vec, episodes=episodes, seed=seed, instructions=[1]
        )

    whole = run(seed=20, episodes=4)
    later = run(seed=22, episodes=2)
    first = run(seed=20, episodes=2)
    again = run(seed=20, episodes=4)
    assert whole == again
    for name in ("right_fingers", "wrong_fingers", "mean_return"):
        halves = [getattr(part.overall, name) for part in (first, later)]
        assert sum(halves) / 2 == pytest.approx(getattr(whole.overall, name))
    assert whole.overall.right_fingers + whole.overall.wrong_fingers > 0


def test_a_sentence_of_a_split_is_played_in_that_split(monkeypatch):
    envs = SimpleNamespace(close=lambda: None)
    monkeypatch.setattr(api, "make_vec", lambda *_, **__: envs)
    monkeypatch.setattr(api, "evaluate_policy", lambda *_, **told: told["instructions"])
    said = {"instruction": "red cube pls"}  # written by hand, for "wording" alone
    told = ir_maniskill.evaluate("NaoInstruct-v1", split="wording", **said)
    assert told == ["red cube pls"]
    with pytest.raises(ValueError, match="got 'pls' as word 3"):
        ir_maniskill.evaluate("NaoInstruct-v1", **said)


def test_a_vector_in_a_split_is_told_sentences_of_it():
    kwargs = {"split": "wording", "obs_mode": "state", "render_backend": "none"}
    envs = ir_maniskill.make_vec("NaoInstruct-v1", 1, **kwargs)
    envs.reset(seed=0, options={"instruction": "red cube pls"})
    assert envs.get_attr("instructions")[0][0].text == "red cube pls"
    envs.close()
