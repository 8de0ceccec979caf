"""Train a policy: `python -m cassie_mjx.train speed=1x`.

The host's loop: iterate, measure, save. A run is a directory with its configuration, metrics, checkpoints and policies;
whatever ends it, the same command with resume=true goes on exactly where the last checkpoint was.
"""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import jax
import mujoco
import numpy as np
from rich.console import Console

from cassie_mjx import cli
from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy import PolicyAgent
from cassie_mjx.agents.policy_file import learner_policy, save_policy
from cassie_mjx.control.step import policy_step
from cassie_mjx.envs.command import limits
from cassie_mjx.evaluation.returns import walk_returns
from cassie_mjx.motion.command import speed_factors
from cassie_mjx.physics.make import make_physics
from cassie_mjx.ppo import networks
from cassie_mjx.ppo.types import Policy
from cassie_mjx.robot.model import ModelConfig
from cassie_mjx.training import checkpoint, counters, devices, divergence, lock, run_directory, schedule, sentences
from cassie_mjx.training.config import TrainConfig, resolve_config
from cassie_mjx.training.counters import NOT_MEASURED, Counters, IntervalStats
from cassie_mjx.training.films import film_policy
from cassie_mjx.training.interruption import Interruption
from cassie_mjx.training.loggers import Sinks, Terminal
from cassie_mjx.training.trainer import IterationMetrics, RunState, Trainer, initial_policy, unlike


class Runner:
    """One process' part of a run: from its start or its last checkpoint to its end or a signal."""

    def __init__(self, config: TrainConfig, console: Console) -> None:
        """Claim the run's directory and read what it holds.

        Raises:
          ValueError: the configuration, the reference or the directory will not do; nothing is written then.
        """
        self.config = config = resolve_config(config)
        self.folder = Path(str(config.run_dir))
        begun = checkpoint.latest(self.folder / "checkpoints") is not None
        init = None if begun else initial_policy(config)
        self.provenance = cli.provenance()
        restored, self.motion, self.law, self.notes = run_directory.claim(self.folder, config, self.provenance)
        self.trainer = Trainer(config, self.motion)
        self.run, self.counters, self.interval = (
            self.trainer.start(learner_policy(init) if init else None),
            Counters(),
            IntervalStats(),
        )
        if restored:
            self.run = self.trainer.place(checkpoint.restore_into(devices.gather(self.run), restored.arrays))
            self.counters, self.interval = counters.from_record(restored.record)
            self.trainer.timer.seconds = self.interval.seconds
        self.saved = self.done if restored else None
        self.begins = restored is None
        self.notes += unlike(config, init, self.motion, self.law) if init else []
        self.terminal = Terminal(console, config.ppo.iterations, self.done)
        self.sinks = Sinks(self.folder, config, self.samples, self.terminal.say) if devices.is_first() else None
        self.eval_engine = make_physics("native", ModelConfig(electronics=config.walk.electronics))
        self.policy_step = jax.jit(partial(policy_step, self.law, self.trainer.env.motion))
        self.clipping_told = False
        self.diagnosed = bool(max(devices.exchange((self.folder / "nan").exists())))

    @property
    def done(self) -> int:
        """Iterations done."""
        return int(self.run.learner.iteration)

    @property
    def samples(self) -> int:
        """Control steps learned from."""
        return self.done * self.config.ppo.num_samples

    def train(self) -> None:
        """Train until the last iteration or a signal, and say what came of it.

        Raises:
          ValueError: the learner's numbers are not finite any more; the last checkpoint and policies stay as they are.
        """
        config = self.config
        with self.terminal, Interruption(self.terminal.say) as interruption, self._closing():
            self.terminal.say(f"{'Resuming' if self.done else 'Training'} in {self.folder}: {sentences.plan(config)}")
            for note in self.notes:
                self.terminal.say(note)
            self._begin()
            total, stopped = config.ppo.iterations, 0
            # A signal to one process stops all of them after the same iteration.
            while self.done < total and not (stopped := max(devices.exchange(interruption.signal))):
                self._iterate()
            if self.saved != self.done:
                self._save()
        if stopped:
            self.terminal.say(
                f"Stopped and saved after iteration {self.done}. To go on:\n  {run_directory.resume_command()}"
            )
            sys.exit(128 + stopped)
        self.terminal.say(sentences.conclusion(self.folder / "best.npz", self.counters))

    @contextmanager
    def _closing(self) -> Iterator[None]:
        try:
            yield
        finally:
            if self.sinks:
                self.sinks.close(self.done == self.config.ppo.iterations)

    def _begin(self) -> None:
        """What a run needs before its first iteration, or before it goes on."""
        if self.begins:
            began = time.perf_counter()
            self.run = jax.block_until_ready(self.trainer.gather_statistics(self.run))
            self._count(time.perf_counter() - began)
            # So that a run without a checkpoint is one that has no results either.
            self._save()
        elif max(devices.exchange(int(devices.is_first() and self._best_is_lost()))):
            if devices.is_first():
                self._replace_best()
            self._save()

    def _best_is_lost(self) -> bool:
        if self.counters.return_plain == NOT_MEASURED:
            return False
        try:
            NumpyPolicy.load(self.folder / "best.npz")
        except (ValueError, OSError):
            return True
        return False

    def _replace_best(self) -> None:
        """Measure the policy of the checkpoint and let it take the place of the best one, and say so."""
        lost = self.counters
        self.counters = replace(lost, return_plain=NOT_MEASURED, return_weighted=NOT_MEASURED)
        policy, returns = self._returns()
        self._keep(policy, returns)
        self.terminal.say(sentences.best_lost(self.folder / "best.npz", lost, self.counters))

    def _iterate(self) -> None:
        began, before = time.perf_counter(), self.run
        after, metrics = self.trainer.iterate(before)
        metrics = jax.device_get(metrics)
        if not metrics.finite:
            raise ValueError(sentences.not_finite(self.config, self.done + 1, self.saved))
        self.run = after
        elapsed = time.perf_counter() - began
        self._count(elapsed)
        self.interval.iterations += 1
        self.interval.ends.update({name: int(count) for name, count in metrics.ends.items()})
        if metrics.ends["nan"] and not self.diagnosed:
            self._diagnose(before)
        rate = self.config.ppo.num_samples / elapsed
        self.terminal.advance(
            float(metrics.update.reward), counters.episode_steps(metrics.update, self.config.walk.episode_steps), rate
        )
        if schedule.saves(self.config, self.done):
            if devices.is_first():
                self._write(metrics)
            self._save()

    def _diagnose(self, before: RunState) -> None:
        """Keep what led to the run's first divergence of the physics; looked for once, for a replay takes time."""
        self.diagnosed = True
        found = self.trainer.replay(before)
        if found and devices.is_first():
            divergence.dump(self.folder / "nan", self.trainer.env.physics, found)
        kept = (
            f"the model and the state before it are in {self.folder / 'nan'}"
            if found
            else "it did not recur in a replay"
        )
        self.terminal.say(f"Physics diverged in iteration {self.done}, which ended an episode; {kept}.")

    def _count(self, seconds: float) -> None:
        self.counters.train_s += seconds
        self.interval.train_s += seconds

    def _agent(self, policy: Policy) -> PolicyAgent:
        """The policy as an agent, compiled once for all policies of the run."""
        network = networks.acting(policy)
        return PolicyAgent("policy", self.law, self.motion, network, self.config.walk.kd_scale, step=self.policy_step)

    def _returns(self) -> tuple[Policy, dict[str, float]]:
        """The present policy, and what it is worth."""
        policy = devices.own_copy(self.run.learner.policy)
        returns = walk_returns(self._agent(policy), self.eval_engine, *self.trainer.env.commands)
        self.counters.walked, self.counters.measurements = returns["steps"], self.counters.measurements + 1
        return policy, returns

    def _write(self, metrics: IterationMetrics) -> None:
        """Write a line of metrics; if it is time to measure the return, with that, and keep the policy."""
        if not schedule.measures(self.config, self.done, self.counters.walked):
            self._log(self._values(metrics, {}, 0.0))
            return
        began = time.perf_counter()
        policy, returns = self._returns()
        self._log(self._values(metrics, returns, time.perf_counter() - began))
        every = self.config.video_every
        if every and self.counters.measurements % every == 0:
            self._film(policy)
        self._keep(policy, returns)
        self._warn_of_clipping(metrics)

    def _log(self, values: dict[str, float]) -> None:
        if self.sinks:
            self.sinks.write(values)
        self.terminal.write(values)

    def _warn_of_clipping(self, metrics: IterationMetrics) -> None:
        """Say, once and at the end of the run, which inputs the networks do not see all of."""
        clipping = sentences.clipping(np.asarray(metrics.clipped), self.law.observation.describe())
        if clipping and (not self.clipping_told or self.done == self.config.ppo.iterations):
            self.clipping_told = True
            self.terminal.say(clipping)

    def _film(self, policy: Policy) -> None:
        """Film the policy for whoever takes films."""
        path = self.folder / "films" / f"{self.done:06}.gif"
        try:
            path.parent.mkdir(exist_ok=True)
            film_policy(path, self._agent(policy), self.config.walk.electronics)
        except (ValueError, OSError) as error:
            self.terminal.say(f"There is no film of iteration {self.done}: {error}")
            return
        if self.sinks:
            self.sinks.film(path, self.samples)

    def _keep(self, policy: Policy, returns: dict[str, float]) -> None:
        """Write the policy as the last one and, if it is that, as the best one."""
        walk, counters = self.config.walk, self.counters
        origin = self.provenance | {"seed": self.config.seed, "samples": self.samples, **returns}
        names = ["last"]
        # No undisturbed return tells which policy is the most robust: under disturbances, it is the last.
        goal = f"return_{walk.reward}"
        if returns[goal] > getattr(counters, goal) or walk.draws:
            counters.return_plain, counters.return_weighted = returns["return_plain"], returns["return_weighted"]
            names.append("best")
        factor, followed = speed_factors(self.config.speed)[0], limits(self.motion, self.trainer.env.commands)
        saved = policy, self.motion, factor, walk.kd_scale, origin, self.law, followed
        for name in names:
            save_policy(self.folder / f"{name}.npz", *saved)

    def _values(self, metrics: IterationMetrics, returns: dict[str, float], eval_s: float) -> dict[str, float]:
        """One line of metrics; counts, rates and shares of the time are those since the last line."""
        interval, self.interval = self.interval, IntervalStats()
        seconds = {"eval": eval_s, **self.trainer.timer.since_last()}
        return {
            "train/iteration": self.done,
            "train/samples": self.samples,
            "train/episode_steps": counters.episode_steps(metrics.update, self.config.walk.episode_steps),
            "train/clipped_share": float(metrics.clipped.max()),
            **{f"train/{name}": count for name, count in interval.ends.items()},
            "time/train_s": self.counters.train_s,
            "time/samples_per_s": interval.iterations * self.config.ppo.num_samples / interval.train_s,
            "time/physics_steps_per_s": interval.iterations * self.trainer.physics_steps / interval.train_s,
            **{f"time/{name}_share": spent / (eval_s + interval.train_s) for name, spent in seconds.items()},
            **{f"eval/{name}": value for name, value in returns.items()},
            **{f"learner/{name}": float(value) for name, value in metrics.update._asdict().items()},
        }

    def _save(self) -> None:
        self.interval.seconds = self.trainer.timer.seconds
        record = {"config": asdict(self.config), "provenance": self.provenance}
        record |= counters.to_record(self.counters, self.interval)
        state = devices.gather(self.run)
        if devices.is_first():
            checkpoint.save(self.folder / "checkpoints", self.done, state, self.motion, record)
        self.saved = self.done


def train_policy(config: TrainConfig) -> Path:
    """Train one policy; what `python -m cassie_mjx.train` does. Returns the run's directory.

    Raises:
      ValueError: the configuration, the reference or the directory will not do, or another training is in it; nothing
        is written then. Or the learner's numbers are not finite any more.
      OSError: the directory cannot be written.
    """
    if config.distributed:
        devices.join()
    config, console = resolve_config(config), Console(quiet=not devices.is_first())
    # Divergences are counted, and the first is kept; MuJoCo would print hundreds of lines about each.
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        with lock.hold(Path(str(config.run_dir)), partial(console.print, soft_wrap=True, markup=False)):
            run = Runner(config, console)
            run.train()
    finally:
        mujoco.set_mju_user_warning(None)
    return run.folder
