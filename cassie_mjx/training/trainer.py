"""What a training run is made of: its configuration, its engine, its state, and one iteration of it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from cassie_mjx.agents.numpy_policy import NumpyPolicy
from cassie_mjx.agents.policy_file import learner_policy
from cassie_mjx.agents.shipped import existing_policy
from cassie_mjx.control.law import ControlLaw
from cassie_mjx.envs.command import command_range
from cassie_mjx.envs.termination import Ends
from cassie_mjx.envs.types import WalkState
from cassie_mjx.envs.walk import WalkEnv
from cassie_mjx.motion.reference import ReferenceMotion
from cassie_mjx.physics.make import ENGINES, make_physics
from cassie_mjx.physics.types import Physics
from cassie_mjx.ppo import learner, networks, normalizer, rollout
from cassie_mjx.ppo.types import LearnerState, Normalizer, Policy, Robots, Rollout, UpdateMetrics
from cassie_mjx.robot import cassie
from cassie_mjx.robot.model import steps_per_control
from cassie_mjx.training import devices, divergence
from cassie_mjx.training.config import TrainConfig
from cassie_mjx.training.loggers import Stopwatch

T = TypeVar("T")


class RunState(NamedTuple):
    """Everything that one iteration hands to the next."""

    learner: LearnerState
    env: Any
    key: jax.Array
    """Data of the key that the keys of all iterations are folded from."""
    hidden: Any
    """What the policy carries of the robots, [B, N]."""

    @property
    def robots(self) -> Robots:
        """Where the robots are, and what the policy carries of them."""
        return Robots(self.env, self.hidden)


class IterationMetrics(NamedTuple):
    """What one iteration measures."""

    update: UpdateMetrics
    ends: dict[str, jax.Array]
    """Episodes that ended by each of `termination.Ends`; one may have ended by several."""
    clipped: jax.Array
    """Share of the samples in which each input of the networks was clipped, [O]."""
    finite: jax.Array
    """Whether all of `update`, and all that the learner now consists of, are finite numbers."""


Learn = Callable[[LearnerState, Rollout, jax.Array], tuple[LearnerState, IterationMetrics]]
"""`learn` with its update bound."""


def initial_policy(config: TrainConfig) -> NumpyPolicy | None:
    """The policy that `config.init` names, if it names one.

    Raises:
      ValueError: there is none, or two; its file is damaged, or its network or inputs are not those of this run, or it
        learned one step and `walk.symmetric` is false.
    """
    if config.init is None:
        return None
    saved = NumpyPolicy.load(existing_policy(config.init, "init"))
    network = "gru" if saved.gru else "mlp"
    if network != config.ppo.network:
        raise ValueError(f"init={config.init} is a {saved.kind}; set ppo.network={network}.")
    first = (len(saved.gru.recurrent_bias),) if saved.gru else ()
    widths = (*first, *(len(bias) for _, bias in saved.weights[:-1]))
    if widths != config.ppo.hidden_sizes:
        raise ValueError(f"init={config.init} has hidden layers of {list(widths)}; set ppo.hidden_sizes to that.")
    if saved.mirror and config.walk.symmetric is False:
        raise ValueError(f"init={config.init} learned one step of the stride alone; set walk.symmetric=true.")
    learner_policy(saved)
    return saved


def unlike(config: TrainConfig, saved: NumpyPolicy, motion: ReferenceMotion, law: ControlLaw) -> list[str]:
    """Sentences about what the policy of `config.init` was trained with and this run is not, besides its speed."""
    notes, kd_scale = [], float(saved.d_gain[0] / cassie.D_GAIN[0])
    if not np.isclose(kd_scale, config.walk.kd_scale, rtol=1e-3):
        notes.append(
            f"init={config.init} was trained with {kd_scale:g} times the published D gains, this run has "
            f"{config.walk.kd_scale:g} times."
        )
    if saved.mirror and not law.symmetric:
        notes.append(f"init={config.init} learned one step of the stride alone, this run learns both.")
    ours, theirs = np.asarray(motion.qpos)[:, 1:], saved.reference_qpos[:, 1:]
    if ours.shape != theirs.shape or np.abs(ours - theirs).max() > 1e-3:
        notes.append(f"init={config.init} imitated another motion than reference={config.reference}.")
    return notes


class Trainer:
    """The compiled or timed functions that a resolved configuration trains with."""

    def __init__(self, config: TrainConfig, motion: ReferenceMotion) -> None:
        """Make the environment; on MuJoCo C, `timer` counts the time in `physics` and `learner`."""
        self.config, self.timer = config, Stopwatch()
        # Where all that robots share belongs, if there is a choice, and in how many parts the robots are.
        self._same: Any = None
        self._parts = 1
        update = partial(learner.update, config.ppo)
        solver = ENGINES[config.physics].training
        model_hz = config.physics_hz or solver.physics_hz
        walk = config.walk
        model = replace(
            solver, physics_hz=model_hz, scene=walk.scene, contacts=config.contacts, electronics=walk.electronics
        )
        physics = make_physics(config.physics, model, config.walk.delay_steps(model_hz))
        commands = command_range(motion, config.speed, config.command)
        if physics.traceable:
            self.env = WalkEnv(physics, motion, config.walk, config.ppo.num_robots, *commands)
            self.collect = partial(rollout.collect, self.env.step, config.ppo)
            self._parts, places = jax.device_count(), None
            if self._parts > 1:
                self.collect, update = devices.on_all(self.collect, update)
                self._same = devices.same_everywhere()
                split = devices.split_by_robot()
                places = RunState(self._same, split, self._same, split)
            # One compiled call an iteration. Left to itself, XLA moves empty arrays, and the next call compiles again.
            whole = partial(iterate, self.collect, partial(learn, update))
            self.iterate = jax.jit(whole, out_shardings=(places, self._same))
        else:
            timed = _TimedPhysics(physics, self.timer)
            self.env = WalkEnv(timed, motion, config.walk, config.ppo.num_robots, *commands)
            self.collect = partial(rollout.collect_on_host, self.env.step, config.ppo)
            self._parts = jax.process_count()
            if self._parts > 1:
                self.collect, update = devices.on_hosts(self.collect, update)
                self._same = devices.same_on_hosts()
                learned = self.timer.timed("learner", jax.jit(partial(learn, update), out_shardings=self._same))
            else:
                learned = partial(learn, self.timer.timed("learner", update))
            self.iterate = partial(iterate, self.collect, learned)

    @property
    def physics_steps(self) -> int:
        """Physics steps of all robots in one iteration."""
        return self.config.ppo.num_samples * steps_per_control(round(1 / self.env.physics.model.opt.timestep))

    def start(self, policy: Policy | None = None) -> RunState:
        """An untrained learner, or one with this policy, and robots at the start of an episode.

        The input statistics are not those of the task yet; see `gather_statistics`.
        """
        init_key, reset_key, _, run_key = self._keys()
        env_state = self.env.reset(reset_key)
        sizes = (self.env.law.observation.size, cassie.NU, env_state.privileged.shape[-1])
        state = learner.init(init_key, self.config.ppo, *sizes)
        if policy is not None:
            state = state._replace(policy=policy._replace(std=state.policy.std))
        robots = self._begin(state.policy, env_state)
        return self.place(RunState(state, robots.env, jax.random.key_data(run_key), robots.hidden))

    def gather_statistics(self, run: RunState) -> RunState:
        """The run with the input statistics of the states that a random policy visits, or the policy begun with.

        They are of robots at the end of a curriculum, whose commands and disturbances are drawn from the whole ranges.
        A policy begun with is the same function of the state afterwards, wherever its inputs were not clipped.
        """
        _, reset_key, statistics_key, _ = self._keys()
        policy, samples = run.learner.policy, self.config.ppo.normalizer_samples
        robots = self._begin(policy, self.env.reset(reset_key, np.ones(self.env.robots)))
        robots = self.place(run._replace(env=robots.env, hidden=robots.hidden)).robots
        begun_with = policy.normalizer.samples > 0
        visit = rollout.policy_statistics if begun_with else rollout.random_policy_statistics
        statistics = visit(self.collect, policy, robots, statistics_key, samples)
        policy = networks.renormalize(policy, statistics) if begun_with else policy._replace(normalizer=statistics)
        return run._replace(learner=self._shared(run.learner._replace(policy=policy)))

    def _begin(self, policy: Policy, env_state: WalkState) -> Robots:
        """Robots at the start of an episode, of which a policy carries nothing yet."""
        robots = rollout.begin(policy, env_state)
        return jax.tree.map(jnp.asarray, robots) if self.env.physics.traceable else robots

    def place(self, run: RunState) -> RunState:
        """A run with all robots, each part of it where it belongs: of robots on the host, this process' share."""
        robots = run.robots
        if self._parts > 1:
            split = partial(jax.device_put, device=devices.split_by_robot())
            robots = split(robots) if self.env.physics.traceable else devices.share_of_host(robots)
        return RunState(self._shared(run.learner), robots.env, self._shared(run.key), robots.hidden)

    def _shared(self, tree: T) -> T:
        return tree if self._same is None else jax.device_put(tree, self._same)

    def replay(self, before: RunState) -> divergence.Divergence | None:
        """What led to the first divergence of the physics in the iteration that began with `before`.

        Every process must call it, and finds the same.
        """
        before = before._replace(learner=devices.own_copy(before.learner), key=devices.own_copy(before.key))
        collect_key, _ = iteration_keys(before)
        shares = [(before.robots, collect_key)]
        if self._parts > 1:
            shares = devices.shares(before.robots, collect_key, self._parts)
        found = (divergence.replay(self.env, self.config.ppo, before.learner.policy, *share) for share in shares)
        return next(filter(None, found), None)

    def _keys(self) -> jax.Array:
        return jax.random.split(jax.random.key(self.config.seed), 4)


def iterate(collect: rollout.Collect, learn: Learn, run: RunState) -> tuple[RunState, IterationMetrics]:
    """Collect experience with the present policy and learn from it."""
    collect_key, update_key = iteration_keys(run)
    robots, experience = collect(run.learner.policy, run.robots, collect_key)
    state, metrics = learn(run.learner, experience, update_key)
    return RunState(state, robots.env, run.key, robots.hidden), metrics


def learn(
    update: devices.Update, state: LearnerState, experience: Rollout, key: jax.Array
) -> tuple[LearnerState, IterationMetrics]:
    """The learner after an update, and what the iteration measures."""
    learned, metrics = update(state, experience, key)
    ends = {name: experience.metrics[name].sum() for name in Ends._fields}
    clipped = _clipped_share(state.policy.normalizer, experience.observation)
    return learned, IterationMetrics(metrics, ends, clipped, _all_finite((learned, metrics)))


@jax.jit
def _clipped_share(statistics: Normalizer, observation: jax.Array) -> jax.Array:
    clipped = jnp.abs(normalizer.normalize(statistics, observation)) >= normalizer.CLIP
    return clipped.mean(axis=(0, 1), dtype=jnp.float32)


@jax.jit
def _all_finite(tree: Any) -> jax.Array:
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


def iteration_keys(run: RunState) -> jax.Array:
    """The keys of the iteration that begins with `run`: to collect with, and to update with."""
    return jax.random.split(jax.random.fold_in(jax.random.wrap_key_data(run.key), run.learner.iteration))


class _TimedPhysics:
    """An engine whose time in `advance` is counted under "physics"."""

    def __init__(self, physics: Physics, timer: Stopwatch) -> None:
        self.model, self.max_delay, self.traceable = physics.model, physics.max_delay, physics.traceable
        self.init, self.bodies = physics.init, physics.bodies
        self.advance = timer.timed("physics", physics.advance)
