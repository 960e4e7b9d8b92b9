"""The runner: steps the envs, evaluates, keeps checkpoints, shows how it goes.

It knows nothing of how the algorithm learns. Legend: N envs.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ir_maniskill.agent.agent import Agent
from ir_maniskill.environment.process_vector import ProcessVectorEnv, Step
from ir_maniskill.environment.senses import State, StateStack
from ir_maniskill.environment.vector import VectorEnv, info_of_step
from ir_maniskill.evaluation.evaluate import EvaluationReport, evaluate_policy
from ir_maniskill.files import write_json
from ir_maniskill.language import KINDS
from ir_maniskill.training import checkpoint, distributed
from ir_maniskill.training.algorithm import Algorithm, Outcome
from ir_maniskill.training.checkpoint import CheckpointError, Stored
from ir_maniskill.training.config import TrainConfig
from ir_maniskill.training.finite import TrainingDivergedError, check_finite
from ir_maniskill.training.run_folder import RunFolder

EVAL_SEED, FINAL_SEED = 1_000_000, 1_050_000
"""Seeds of the episodes that choose the best policy, and of those that judge it in the
end; those of training are from 2**30 on."""

FINAL_EPISODES = 100
"""Episodes of the last evaluation, of the policy that is kept; one for each sentence
if those are more."""

Figures = dict[str, float]


class Runner:
    """One run: the algorithm, its envs, and how far it has come.

    Scenes are reseeded from (seed, steps) at the start and after every checkpoint, so
    that a run resumed there meets those of one that was never interrupted. Several
    ranks have the scenes of one with all envs. The first one's random states are in the
    checkpoint; the others draw anew from (seed, steps, rank) after it.
    """

    newest: Stored
    """Snapshot after the last complete update."""

    def __init__(
        self,
        config: TrainConfig,
        folder: RunFolder,
        envs: VectorEnv,
        eval_envs: Callable[[], VectorEnv],
        algorithm: type[Algorithm],
    ) -> None:
        """Make what is still untrained; the config has the experiment's senses.

        `envs` are this rank's share, `eval_envs` returns those to evaluate in, always
        the same ones: an evaluation changes nothing.
        """
        self.config, self.folder = config, folder
        self.envs, self.eval_envs = envs, eval_envs
        self.device = algorithm.device()
        self.stack, self.counts = StateStack(config.frames), StepCounts()
        self.steps, self.saved, self.evaluated = 0, 0, 0
        self.best_score = -math.inf
        torch.manual_seed(config.seed)
        # The cores belong to the simulator's workers and to the pieces of a batch.
        torch.set_num_threads(1)
        self.state = self._new_scenes()
        actions = math.prod(envs.single_action_space.shape or ())
        self.algorithm = algorithm(config, self.state, actions)

    # -- The loop --------------------------------------------------------------------

    def learn(self) -> None:
        """Train until the steps are used up, rounded up to the next update."""
        total = self.config.total_steps
        self.evaluated = distributed.from_first(
            lambda: self.folder.begin(self.config, self.steps)
        )
        self.newest = self.snapshot()
        self._write()  # shows at once that we can
        silent = distributed.rank() > 0
        bar = tqdm(total=total, initial=self.steps, unit=" steps", disable=silent)
        with bar, self._kept_at_last():
            if self.steps == 0 and self.config.init_from is not None:
                self.evaluate()  # the best may be what it begins with
            while True:
                if self._evaluation_is_due():
                    self.evaluate()
                if self._due(self.config.checkpoint_interval, self.saved):
                    self.save()
                if self.steps >= total:
                    break
                figures = self.advance()
                self.newest = self.snapshot()
                bar.set_postfix_str(_shown(figures))
                bar.update(self.steps - bar.n)
            self._write()
        distributed.from_first(self.confirm)

    def advance(self) -> Figures:
        """Step the envs until the algorithm has learned something."""
        figures: Figures = {}
        self.seconds = {"update": 0.0}
        started = time.perf_counter()
        while not figures:
            figures = self.step()
        spent = time.perf_counter() - started
        self.seconds["collect"] = spent - self.seconds["update"]
        means, self.counts = self.counts.means(), StepCounts()
        figures = {f"train/{k}": v for k, v in means.items()} | figures
        figures |= {f"time/{k}": v for k, v in self.seconds.items()}  # [s]
        if distributed.rank() == 0:
            self.folder.log("metrics", self.steps, figures)
        return figures

    def step(self) -> Figures:
        """Let the algorithm act in all envs, see what that led to, and learn.

        Returns:
            Figures of what it learned, if it is time for them.
        """
        check_finite(self.state, "observation", "the simulation became unstable")
        action = self.algorithm.act(self.state)
        figures, stepped = self._stepped(action.to(self.envs.device))
        obs, reward, terminated, truncated, info = stepped
        done, final = terminated | truncated, None
        if "final_info" in info:
            final = self._here(self.stack.peek(info["final_obs"]))
        info = info_of_step(info, done)
        self.state = self._here(self.stack.push(obs, done))
        self.counts.add(reward, done, info)
        told = {"reward": reward, "terminated": terminated, "truncated": truncated}
        if "reward_terms" in info:
            told["terms"] = info["reward_terms"]
        check_finite(told, "outcome", "the simulation became unstable")
        here = self._here(told)
        self.algorithm.observe(Outcome(**here, state=self.state, final=final))
        self.steps += self.config.num_envs
        figures = self._learned() if figures is None else figures
        self._tell_share()
        return figures

    def _tell_share(self) -> None:
        self.algorithm.share = min(self.steps / self.config.total_steps, 1.0)

    def _stepped(self, action: Tensor) -> tuple[Figures | None, Step]:
        """Step all envs; if the algorithm can, let it learn meanwhile.

        Returns:
            The figures, or None if it has yet to learn; what the step led to.
        """
        together = self.algorithm.learns_while_stepping
        if not (together and isinstance(self.envs, ProcessVectorEnv)):
            return None, self.envs.step(action)
        self.envs.step_async(action)
        figures = self._learned()
        return figures, self.envs.step_wait()

    def _learned(self) -> Figures:
        started = time.perf_counter()
        figures = self.algorithm.update()
        self.seconds["update"] += time.perf_counter() - started
        return figures

    def _here(self, state: State) -> State:
        """Return tensors on the learner's device."""
        return {key: value.to(self.device) for key, value in state.items()}

    def _new_scenes(self) -> State:
        """Start new episodes whose scenes follow from (seed, steps) alone."""
        rank = distributed.rank()
        if rank > 0:
            torch.manual_seed(_entropy(self.config.seed, self.steps, rank))
        # A quarter of the seeds, beyond those of evaluations.
        seed = 2**30 + _entropy(self.config.seed, self.steps) % 2**29
        obs, _ = self.envs.reset(seed=seed + rank * self.envs.num_envs)
        self.counts = StepCounts()
        return self._here(self.stack.reset(obs))

    # -- Evaluation ------------------------------------------------------------------

    def evaluate(self) -> None:
        """Evaluate the policy on pinned scenes; keep it if it is the best so far."""
        figures = distributed.from_first(self._evaluate)
        self.newest = self.snapshot()  # the best score may be new
        if distributed.rank() == 0:  # at last: what has no record is made again
            self.folder.log("evaluations", self.steps, figures)
        self.evaluated = self.steps

    def _evaluate(self) -> Figures:
        agent = self.algorithm.agent
        report = self._report(agent, self.config.eval_episodes, EVAL_SEED)
        score = score_of(report, fingers=self.state["touch"].shape[2])
        figures, better = figures_of(report), score > self.best_score
        tqdm.write(
            f"step {self.steps}: {_shown(figures)}" + ", the best so far" * better
        )
        if better:
            self.best_score = score
            self._keep(agent, self.steps, report)
        return figures

    def confirm(self) -> None:
        """Evaluate the best policy on other scenes than those it was chosen by."""
        agent, _, metadata = checkpoint.load_agent(self.folder.best)
        episodes = max(FINAL_EPISODES, len(self.envs.experiment.sentences))
        report = self._report(agent.to(self.device), episodes, FINAL_SEED)
        tqdm.write(f"The best policy, of step {metadata['steps']}, in other scenes:")
        tqdm.write(str(report))
        figures = self._keep(agent, metadata["steps"], report)
        write_json(self.folder.path / "evaluation.json", figures)

    def _report(self, agent: Agent, episodes: int, seed: int) -> EvaluationReport:
        """Evaluate an agent without holding what training goes on with."""
        random = checkpoint.random_state()
        report = evaluate_policy(
            agent.policy,
            self.eval_envs(),
            episodes=episodes,
            seed=seed,
            frames=self.config.frames,
            progress=True,
        )
        checkpoint.set_random_state(random)
        return report

    def _keep(
        self, agent: Agent, steps: int, report: EvaluationReport
    ) -> dict[str, Any]:
        """Write the policy as the best one, with its figures, and return these."""
        path, config, figures = self.folder.best, self.config, report.as_dict()
        checkpoint.save_policy(path, agent, config, steps=steps, evaluation=figures)
        return figures

    def _evaluation_is_due(self) -> bool:
        """Whether a multiple of the interval, or the end, is not evaluated yet."""
        ended = self.steps >= self.config.total_steps and self.steps > self.evaluated
        due = self._due(self.config.eval_interval, self.evaluated)
        return ended or (due and self.algorithm.has_policy)

    def _due(self, interval: int, before: int) -> bool:
        """Whether a multiple of the interval was passed since that many steps."""
        return self.steps // interval > before // interval

    # -- Checkpoints -----------------------------------------------------------------

    def snapshot(self) -> Stored:
        """Return everything the run needs to go on, as of now."""
        facts = {"steps": self.steps, "best_score": self.best_score}
        metadata = checkpoint.describe(self.algorithm.agent, self.config, **facts)
        tensors = checkpoint.random_state() | self.algorithm.state_dict()
        return Stored(checkpoint.CHECKPOINT, tensors, metadata)

    def save(self) -> None:
        """Write a checkpoint, and go on with new scenes as a resumed run would."""
        self._write()
        self.saved = self.steps
        self.state = self._new_scenes()
        self.algorithm.restart()

    def _write(self) -> None:
        """Write the first rank's newest snapshot as the last checkpoint."""
        distributed.from_first(lambda: checkpoint.write(self.folder.last, self.newest))

    @contextlib.contextmanager
    def _kept_at_last(self) -> Iterator[None]:
        """Leave the newest snapshot as the last checkpoint, whatever stops it."""
        try:
            yield
        except BaseException as error:
            diverged = isinstance(error, TrainingDivergedError)
            failed = isinstance(error, Exception) and self.newest.metadata["steps"] == 0
            if distributed.rank() == 0 and failed:
                self.folder.forget()  # what is wrong may be in the config
            # Where it diverged, the older checkpoint is the good one.
            elif distributed.rank() == 0 and not diverged:
                self.folder.save_at_last(self.newest)
            raise

    def restore(self, stored: Stored) -> None:
        """Go on from a checkpoint.

        Raises:
            CheckpointError: If it does not fit the algorithm.
        """
        if self.folder.best.exists():  # better refused now than at the end
            try:
                checkpoint.read(self.folder.best)
            except CheckpointError as error:
                hint = "or move it away: the next evaluation makes another"
                raise CheckpointError(f"{error}; {hint}") from error
        try:
            self.algorithm.load_state_dict(stored.tensors)
            checkpoint.set_random_state(stored.tensors)
            if self.folder.best.exists():  # else the next evaluation's is the best
                self.best_score = float(stored.metadata["best_score"])
            steps = stored.metadata["steps"]
            if type(steps) is not int or steps < 0:
                raise ValueError(f"steps: got {steps!r}, expected a whole number")
            self.steps = self.saved = steps
        except checkpoint.MALFORMED as error:
            raise CheckpointError(
                f"{self.folder.last} does not fit this agent: {error}; train anew in "
                "another folder"
            ) from error
        self._tell_share()
        self.state = self._new_scenes()
        self.algorithm.restart()


# -- Counting --------------------------------------------------------------------------


class StepCounts:
    """Sums over the steps made, for the log."""

    def __init__(self) -> None:
        """Start with nothing counted."""
        self.sums = torch.zeros(7, dtype=torch.float64)

    def add(self, reward: Tensor, done: Tensor, info: dict[str, Tensor]) -> None:
        """Count one step of all envs: all that is counted of episodes at their end."""
        counted = (
            torch.ones_like(done),
            reward,
            info["success"],  # the goal holds
            info["wrong_fingers"] > 0,
            done,
            info["success_once"] & done,
            info["exclusive_success"] & done,
        )
        self.sums += torch.stack([each.double().sum() for each in counted]).cpu()

    def means(self) -> Figures:
        """Return the figures per step and per episode; NaN of none that ended."""
        joined = distributed.gather(self.sums[None]).sum(dim=0).tolist()
        steps, reward, holding, wrong, episodes, success, exclusive = joined
        episodes = episodes or math.nan
        return {
            "return": reward / episodes,
            "reward": reward / steps,
            "success": success / episodes,
            "exclusive": exclusive / episodes,
            "holding": holding / steps,
            "wrong": wrong / steps,
        }


def score_of(report: EvaluationReport, fingers: int) -> float:
    """Return by what the best policy is chosen.

    That sums the worst sentence's success, the exclusive success, the share of steps in
    which the goal holds, and that of the fingers which touch as it asks.
    """
    figures = figures_of(report)
    held = figures["eval/holding"] + figures["eval/right_fingers"] / fingers
    return figures["eval/worst"] + figures["eval/exclusive"] + held


def figures_of(report: EvaluationReport) -> Figures:
    """Return the figures of an evaluation that are worth a curve."""
    names = ("success", "exclusive", "holding", "right_fingers", "wrong_fingers")
    overall = report.overall.as_dict()
    worst = min(score.success.value for score in report.instructions.values())
    figures = {"eval/worst": worst} | {f"eval/{name}": overall[name] for name in names}
    for name, score in report.instructions.items():
        if name in KINDS:
            figures[f"eval/{name}"] = score.exclusive.value
    return figures


SHOWN = {
    "train/return": "return {:.2f}",
    "train/success": "success {:.0%}",
    "penalty": "penalties {:.0%}",
    "std": "noise {:.2f}",
    "eval/success": "success {:.0%}",
    "eval/worst": "worst sentence {:.0%}",
    "eval/exclusive": "exclusive {:.0%}",
    "eval/holding": "holding {:.0%}",
    "eval/right_fingers": "{:.1f} fingers",
}
"""Figures that the progress bar and the lines of evaluations show, and how."""


def _shown(figures: Figures) -> str:
    """Return what is said of figures."""
    return ", ".join(SHOWN[k].format(figures[k]) for k in SHOWN if k in figures)


def _entropy(*numbers: int) -> int:
    """Return a seed that mixes the numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
