"""The training loop: collect, improve, evaluate, keep."""

import contextlib
import dataclasses
import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tqdm import tqdm

from ir_maniskill import experiment as catalog
from ir_maniskill.agent.agent import Agent, StateSpec
from ir_maniskill.agent.config import Sense
from ir_maniskill.checks import ConfigError
from ir_maniskill.environment.state import State, StateStack
from ir_maniskill.environment.vector import VectorEnv, make_vec
from ir_maniskill.evaluation.evaluate import EvaluationReport, evaluate_policy
from ir_maniskill.experiment import Experiment
from ir_maniskill.training import checkpoint, distributed, ppo
from ir_maniskill.training.checkpoint import CheckpointError, Stored
from ir_maniskill.training.config import TrainConfig, decode
from ir_maniskill.training.finite import TrainingDivergedError
from ir_maniskill.training.rollout import RewardScale, Rollout, collect, to
from ir_maniskill.training.run_folder import RunFolder

MAY_CHANGE = {
    *("out", "total_steps", "stop_at_success"),
    *("sim_backend", "render_backend", "num_workers", "threads"),
    *("eval_interval", "eval_episodes", "checkpoint_interval"),
}
"""Fields of the config that a resumed run may set anew."""

FINAL_EPISODES = 100
"""Episodes of the last evaluation, of the policy that is kept; one for each sentence
if those are more."""


def train(
    config: TrainConfig, resume: bool = False, envs: VectorEnv | None = None
) -> Path:
    """Train an agent and return the file of its best policy.

    Whatever stops it (Ctrl-C, a worker that fails, a full disk) leaves a checkpoint of
    the last complete update; numbers that are not finite leave the one before. Where
    torchrun started several processes, each trains on its share of the envs.

    Args:
        config: Task, learner, budget and folder.
        resume: Go on from the folder's last checkpoint, if there is one.
        envs: Vector of this rank's envs to use (and leave open) instead of making one.

    Raises:
        CheckpointError: If the folder or its checkpoint cannot be used.
        ConfigError: If the envs cannot be shared evenly among the ranks, those given
            are others than the config says, or an evaluation has too few episodes.
        RankError: If another rank failed.
        TrainingDivergedError: If a number stopped being finite.
        WorkerError: If a simulator process died or hangs.
    """
    with contextlib.ExitStack() as leaving:
        leaving.enter_context(distributed.group())
        _require_shares(config)
        folder = distributed.from_first(
            lambda: RunFolder(Path(config.out), resume=resume)
        )
        leaving.callback(folder.close)
        leaving.callback(torch.set_num_threads, torch.get_num_threads())
        if envs is None:
            experiment = catalog.get(config.env_id)
            envs = _make_envs(_for_experiment(config, experiment))
            leaving.callback(envs.close)
        _require_fit(config, envs)
        trainer = Trainer(config, envs, folder)
        if distributed.from_first(lambda: resume and folder.last.exists()):
            trainer.restore()
        trainer.learn()
    return folder.best


def _for_experiment(config: TrainConfig, experiment: Experiment) -> TrainConfig:
    """Return the config with what the experiment decides: senses and vocabulary."""
    senses = config.agent.senses or tuple(cast("tuple[Sense, ...]", experiment.senses))
    words = len(experiment.vocabulary)
    agent = dataclasses.replace(config.agent, senses=senses, vocabulary=words)
    return dataclasses.replace(config, agent=agent)


def _require_shares(config: TrainConfig) -> None:
    """Raise unless every rank gets equal parts of the envs and of each minibatch."""
    ranks, minibatch = distributed.size(), config.ppo.minibatch
    if config.num_envs % ranks:
        raise ConfigError(
            f"num_envs: got {config.num_envs}, expected a multiple of {ranks}: the "
            "ranks share them"
        )
    if minibatch is not None and minibatch < ranks:
        raise ConfigError(
            f"minibatch: got {minibatch}, expected at least {ranks}: the ranks share it"
        )


def _require_fit(config: TrainConfig, envs: VectorEnv) -> None:
    """Raise unless the envs are those of the config, and it evaluates them wholly."""
    task, share = envs.experiment.id, config.num_envs // distributed.size()
    if task != config.env_id:
        raise ConfigError(
            f"env_id: got {config.env_id!r}, expected {task!r}, the task of the envs "
            "given; change it, or make envs of that task"
        )
    if envs.num_envs != share:
        raise ConfigError(
            f"num_envs: got a vector of {envs.num_envs} envs, expected {share}, which "
            f"is this rank's share of {config.num_envs}; change one of them"
        )
    sentences = len(envs.experiment.sentences)
    if config.eval_episodes < sentences:
        raise ConfigError(
            f"eval_episodes: got {config.eval_episodes}, expected at least "
            f"{sentences}, one for each sentence"
        )


def _make_envs(config: TrainConfig) -> VectorEnv:
    """Make this rank's envs, on its device."""
    device, kwargs = distributed.device(), config.env_kwargs(training=True)
    sim_backend, render_backend = str(config.sim_backend), str(config.render_backend)
    if device.index is not None:  # of several GPUs, this rank's
        sim_backend = sim_backend.replace("cuda", str(device))
        render_backend = render_backend.replace("auto", f"sapien_{device}")
    return make_vec(
        config.env_id,
        config.num_envs // distributed.size(),
        num_workers=config.num_workers or distributed.cores(),
        sim_backend=sim_backend,
        render_backend=render_backend,
        **kwargs,
    )


class Trainer:
    """One run: the agent, its optimizer, its envs, and how far it has come.

    Scenes are reseeded from (seed, steps) at the start and after every checkpoint, so
    that a run resumed there meets the same scenes as one that was never interrupted.
    Several ranks have the scenes of one with all envs. The first one's random states
    are in the checkpoint; the others draw anew from (seed, steps, rank) after it.
    """

    newest: Stored
    """Snapshot after the last complete update."""

    def __init__(self, config: TrainConfig, envs: VectorEnv, folder: RunFolder) -> None:
        """Make an untrained agent for these envs."""
        config = _for_experiment(config, envs.experiment)
        self.config, self.envs, self.folder = config, envs, folder
        self.device = distributed.device()
        self.stack = StateStack(config.frames)
        torch.manual_seed(config.seed)
        torch.set_num_threads(1)  # orthogonal weights depend on it in their last bits
        self.steps, self.evaluated, self.best_score = 0, 0, -math.inf
        self.reward_scale = RewardScale(envs.num_envs, config.ppo.gamma)
        self.state = self._fresh_scenes()
        actions = math.prod(envs.single_action_space.shape or ())
        spec = StateSpec.of(self.state, actions)
        self.agent = Agent(config.agent, spec).to(self.device)
        distributed.copy_from_first(self.agent)
        rate = config.ppo.learning_rate
        self.optimizer = torch.optim.Adam(self.agent.parameters(), rate, eps=1e-5)
        self.rollout = Rollout(config.steps_per_env, self.state, actions)

    def learn(self) -> None:
        """Train until the steps are used up or the goal is reached."""
        size = self.config.steps_per_update
        total = math.ceil(self.config.total_steps / size) * size
        self.evaluated = distributed.from_first(
            lambda: self.folder.begin(self.config, self.steps)
        )
        self.newest = self.snapshot()
        self._write()  # shows at once that we can
        silent, reached = distributed.rank() > 0, False
        bar = tqdm(total=total, initial=self.steps, unit=" steps", disable=silent)
        with bar, self._kept_at_last():
            while not reached:
                if self._evaluation_is_due(total):
                    reached = self._evaluate_and_save()
                elif self.steps < total:
                    figures = self.update()
                    self.newest = self.snapshot()
                    bar.set_postfix_str(_summary(figures))
                    bar.update(size)
                    due = self._due(self.config.checkpoint_interval)
                    if due and not self._evaluation_is_due(total):
                        self.save()
                else:
                    break
        distributed.from_first(self.confirm)

    def update(self) -> dict[str, float]:
        """Collect roll-outs and improve the agent on them."""
        config, start = self.config, time.perf_counter()
        self._anneal()
        self._set_price()
        torch.set_num_threads(1)  # the cores belong to the simulator's workers
        self.state, sums = collect(
            self.envs, self.stack, self.state, self.agent, self.rollout, config.ppo
        )
        if config.ppo.normalize_reward:
            self.rollout.reward = self.reward_scale(
                self.rollout.reward, self.rollout.done
            )
        with torch.no_grad():
            last_value = self.agent.value(self.state)
        self.rollout.finish(last_value, config.ppo.gamma, config.ppo.gae_lambda)
        collected = time.perf_counter()
        torch.set_num_threads(config.threads or distributed.cores())
        figures = ppo.update(self.agent, self.optimizer, self.rollout, config.ppo)
        if "privileged" in self.rollout.state:
            seen = distributed.gather(self.rollout.state["privileged"].flatten(0, 1))
            self.agent.observe(seen)
        self.steps += config.steps_per_update
        done = time.perf_counter()
        figures = {f"loss/{name}": value for name, value in figures.items()}
        figures["std"] = float(self.agent.actor.log_std.exp().mean())
        figures["time/collect"] = collected - start  # [s]
        figures["time/update"] = done - collected  # [s]
        means = sums.over_ranks().means()
        figures = {f"train/{k}": v for k, v in means.items()} | figures
        if distributed.rank() == 0:
            self.folder.log("metrics", self.steps, figures)
        return figures

    def _evaluate_and_save(self) -> bool:
        """Return whether an evaluation, made now, finds the goal reached."""
        figures = distributed.from_first(self.evaluate)
        self.newest = self.snapshot()  # the best score may be new
        self.save()  # the evaluation left scenes in disorder
        if distributed.rank() == 0:  # at last: what has no record is made again
            self.folder.log("evaluations", self.steps, figures)
        self.evaluated = self.steps
        goal = self.config.stop_at_success
        return goal is not None and figures["eval/worst"] >= goal

    def evaluate(self) -> dict[str, float]:
        """Evaluate the policy on pinned scenes; keep it if it is the best so far.

        The best has the highest sum, equally weighted, of the worst sentence's success,
        the exclusive success and the share of steps in touch; where each finger
        counts, of all fingers instead, that are on the named object.
        """
        report = self._report(self.agent, self.config.eval_episodes)
        figures = _figures(report)
        held = figures["eval/touching"]
        score = figures["eval/worst"] + figures["eval/exclusive"] + held
        if score > self.best_score:
            self.best_score = score
            self._keep(self.agent, self.steps, report)
        return figures

    def confirm(self) -> None:
        """Evaluate the best policy on other scenes than those it was chosen by."""
        agent, _, metadata = checkpoint.load_policy(self.folder.best)
        agent.to(self.device)
        episodes = max(FINAL_EPISODES, len(self.envs.experiment.sentences))
        report = self._report(agent, episodes, seed=self.config.eval_seed + 50_000)
        figures = self._keep(agent, metadata["steps"], report)
        text = json.dumps(figures, indent=2)
        path = self.folder.path / "evaluation.json"
        checkpoint.replace(path, (text + "\n").encode())

    def snapshot(self) -> Stored:
        """Return everything the run needs to go on, as of now."""
        tensors, plain = checkpoint.random_state()
        facts = {
            "steps": self.steps,
            "best_score": self.best_score,
            "reward_scale": self.reward_scale.state_dict(),
            "learning_rate": self.optimizer.param_groups[0]["lr"],
            "random": plain,
        }
        metadata = checkpoint.describe(self.agent, self.config, **facts)
        tensors |= checkpoint.pack(self.agent, self.optimizer)
        return Stored(checkpoint.CHECKPOINT, tensors, metadata)

    def save(self) -> None:
        """Write a complete checkpoint, and go on with fresh scenes as a resumed run."""
        self._write()
        self.state = self._fresh_scenes()

    def _write(self) -> None:
        """Write the first rank's newest snapshot as the last checkpoint."""
        distributed.from_first(lambda: self.folder.save(self.newest))

    @contextlib.contextmanager
    def _kept_at_last(self) -> Iterator[None]:
        """Leave the newest snapshot as the last checkpoint, whatever stops it."""
        try:
            yield
        except BaseException as error:
            diverged = isinstance(error, TrainingDivergedError)
            # Where it diverged, the older checkpoint is the good one.
            if distributed.rank() == 0 and not diverged:
                self.folder.save_at_last(self.newest)
            raise

    def restore(self) -> None:
        """Go on from the folder's last checkpoint.

        Raises:
            CheckpointError: If it is broken, or of another task or config.
        """
        path = self.folder.last
        stored = distributed.from_first(lambda: checkpoint.read(path))
        if stored.kind != checkpoint.CHECKPOINT:
            raise CheckpointError(
                f"{path}: got a policy, expected a complete checkpoint to resume from"
            )
        try:
            self._require_same(decode(TrainConfig, stored.metadata["config"]))
            checkpoint.unpack(stored.tensors, self.agent, self.optimizer)
            checkpoint.set_random_state(stored.tensors, stored.metadata["random"])
            self.reward_scale.load_state_dict(stored.metadata["reward_scale"])
            self.best_score = float(stored.metadata["best_score"])
            rate = _positive(stored.metadata["learning_rate"])
            for group in self.optimizer.param_groups:
                group["lr"] = rate
            self.steps = _whole_steps(stored.metadata["steps"])
        except checkpoint.MALFORMED as error:
            if isinstance(error, CheckpointError):
                raise
            raise CheckpointError(
                f"{path} does not fit this agent: {error}; train anew in another folder"
            ) from error
        self.state = self._fresh_scenes()

    def _require_same(self, stored: TrainConfig) -> None:
        """Raise unless the checkpoint was made with this config."""
        got, expected = dataclasses.asdict(stored), dataclasses.asdict(self.config)
        different = [
            f"{name} (checkpoint: {got[name]!r}, now: {expected[name]!r})"
            for name in got
            if name not in MAY_CHANGE and got[name] != expected[name]
        ]
        if different:
            raise CheckpointError(
                f"{self.folder.last} was made with another config: "
                + ", ".join(different)
                + "; resume with the same values, or train in another folder"
            )

    def _report(
        self, agent: Agent, episodes: int, seed: int | None = None
    ) -> EvaluationReport:
        """Evaluate an agent in the training envs without touching random states."""
        tensors, plain = checkpoint.random_state()
        report = evaluate_policy(
            agent.policy,
            self.config.env_id,
            episodes=episodes,
            seed=self.config.eval_seed if seed is None else seed,
            frames=self.config.frames,
            envs=self.envs,
        )
        checkpoint.set_random_state(tensors, plain)
        return report

    def _keep(
        self, agent: Agent, steps: int, report: EvaluationReport
    ) -> dict[str, Any]:
        """Write the policy as the best one, with its figures, and return these."""
        path, config = self.folder.best, self.config
        # The return is of the reward learned from, elsewhere it is of the sparse one.
        figures = {**report.as_dict(), "reward_mode": config.reward_mode}
        checkpoint.save_policy(path, agent, config, steps=steps, evaluation=figures)
        return figures

    def _fresh_scenes(self) -> State:
        """Start new episodes whose scenes follow from (seed, steps) alone."""
        rank = distributed.rank()
        if rank > 0:
            torch.manual_seed(_entropy(self.config.seed, self.steps, rank))
        # A quarter of the seeds, beyond those that an `eval_seed` may be.
        seed = 2**30 + _entropy(self.config.seed, self.steps) % 2**29
        obs, _ = self.envs.reset(seed=seed + rank * self.envs.num_envs)
        self.reward_scale.restart()
        return to(self.stack.reset(obs), self.device)

    def _anneal(self) -> None:
        """Let noise and posture gain change with the share of the steps made."""
        agent = self.config.agent
        share = min(self.steps / self.config.total_steps, 1.0)
        gain, final = agent.posture_gain, agent.posture_gain_final
        if final is not None:
            self.agent.actor.set_gain(gain + share * (final - gain))
        if agent.std_mode == "annealed":
            self.agent.actor.set_std(agent.std + share * (agent.std_final - agent.std))
        elif agent.std_mode == "decayed":
            self.agent.actor.set_std(agent.std * (agent.std_final / agent.std) ** share)

    def _set_price(self) -> None:
        """Let the price of touching other objects grow with the steps made."""
        pass

    def _due(self, interval: int) -> bool:
        """Whether a multiple of the interval was passed by the last update."""
        before = self.steps - self.config.steps_per_update
        return self.steps // interval > before // interval

    def _evaluation_is_due(self, total: int) -> bool:
        """Whether a multiple of the interval, or the end, is not evaluated yet."""
        interval = self.config.eval_interval
        passed = self.steps // interval > self.evaluated // interval
        return passed or (self.steps >= total and self.steps > self.evaluated)


def _figures(report: EvaluationReport) -> dict[str, float]:
    """Return the figures of an evaluation that are worth a curve."""
    names = ("success", "exclusive", "touching", "right_fingers", "wrong_fingers")
    overall = report.overall.as_dict()
    worst = min(score.success.value for score in report.instructions.values())
    return {"eval/worst": worst} | {f"eval/{name}": overall[name] for name in names}


def _summary(figures: dict[str, float]) -> str:
    """Return what the progress bar says."""
    reward, success = figures["train/return"], figures["train/success"]
    return f"return {reward:.2f}, success {success:.0%}"


def _whole_steps(got: object) -> int:
    """Return the step count of a checkpoint."""
    if type(got) is not int or got < 0:
        raise ValueError(f"steps: got {got!r}, expected a whole number")
    return got


def _positive(got: object) -> float:
    """Return the step size of a checkpoint."""
    if not isinstance(got, float) or not 0 < got < math.inf:
        raise ValueError(f"learning_rate: got {got!r}, expected a number above 0")
    return got


def _entropy(*numbers: int) -> int:
    """Return a seed that mixes the numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
