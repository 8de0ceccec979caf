"""Data parallelism: the robots split over all devices of all hosts, the learner the same on each of them.

With several hosts, each runs the same program in a process of its own on arrays that span them all. Every process must
reach the functions below that say so; the first process alone writes files and speaks. On MuJoCo C robots are arrays of
the host: each process has a share of its own, and one device to learn from it.
"""

import os
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Key

from cassie_mjx.physics.native import cores
from cassie_mjx.ppo.rollout import Collect
from cassie_mjx.ppo.types import LearnerState, Policy, Robots, Rollout, UpdateMetrics

AXIS = "devices"

FEW_CORES = 4
"""Cores up to which the learner computes on one of them."""

T = TypeVar("T")

Update = Callable[..., tuple[LearnerState, UpdateMetrics]]

_SAME, _ROBOTS, _STEPS_AND_ROBOTS = PartitionSpec(), PartitionSpec(AXIS), PartitionSpec(None, AXIS)


def join() -> None:
    """Join the other processes that the cluster has started for the same command.

    Raises:
      ValueError: there is no cluster that JAX knows.
    """
    if jax.distributed.is_initialized():
        return
    try:
        jax.distributed.initialize()
    except ValueError as error:
        raise ValueError(
            f"distributed=true found no other processes ({error}) Start the command with srun or mpirun."
        ) from error


def share_cores() -> None:
    """On few cores, leave them to the physics' threads: XLA reads this when it first looks for devices."""
    if cores() <= FEW_CORES:
        os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")


def accelerator() -> str | None:
    """What JAX calls the accelerator that it computes on by itself; None if it has only the CPU."""
    share_cores()
    return None if jax.default_backend() == "cpu" else jax.local_devices()[0].device_kind


def is_first() -> bool:
    """Whether this is the process that writes files and speaks."""
    return jax.process_index() == 0


def exchange(value: int) -> list[int]:
    """What each process has, 0 to 2^32 - 1; every process must call it, and waits here for the others."""
    return [value] if jax.process_count() == 1 else multihost_utils.process_allgather(np.uint32(value)).tolist()


def same_everywhere() -> NamedSharding:
    """Where arrays belong that every device has a copy of."""
    return NamedSharding(_mesh(), _SAME)


def same_on_hosts() -> NamedSharding:
    """Where arrays belong that every process has a copy of, to learn from robots on its host."""
    return NamedSharding(_one_a_process(), _SAME)


def split_by_robot() -> NamedSharding:
    """Where arrays belong whose first axis counts robots."""
    return NamedSharding(_mesh(), _ROBOTS)


def on_all(collect: Collect, update: Update) -> tuple[Collect, Update]:
    """Both halves of an iteration on all devices at once, each device with its share of the robots.

    Args:
      collect: draws from its key what happens to the robots; each device gets a key of its own.
      update: `ppo.learner.update` with its configuration bound; each device gets the same key and makes the same step.
    """

    def collect_share(policy: Policy, robots: Robots, key: Key[Array, ""]) -> tuple[Robots, Rollout]:
        return collect(policy, robots, jax.random.fold_in(key, jax.lax.axis_index(AXIS)))

    spread = partial(jax.shard_map, mesh=_mesh(), check_vma=False)
    return (
        jax.jit(spread(collect_share, in_specs=(_SAME, _ROBOTS, _SAME), out_specs=(_ROBOTS, _STEPS_AND_ROBOTS))),
        spread(partial(update, axis_name=AXIS), in_specs=(_SAME, _STEPS_AND_ROBOTS, _SAME), out_specs=_SAME),
    )


def on_hosts(collect: Collect, update: Update) -> tuple[Collect, Update]:
    """Both halves of an iteration in all processes at once, each stepping its share of the robots on its host.

    That is what one process does with all robots if it draws what happens to each share from the key of that share's
    process.

    Args:
      collect: as in `on_all`, but on the host; each process gets a key of its own.
      update: as in `on_all`.
    """
    mesh = _one_a_process()
    everyones = partial(jax.make_array_from_process_local_data, NamedSharding(mesh, _STEPS_AND_ROBOTS))

    def collect_share(policy: Policy, robots: Robots, key: Key[Array, ""]) -> tuple[Robots, Rollout]:
        own_key = jax.random.wrap_key_data(own_copy(jax.random.key_data(key)))
        robots, lived = collect(own_copy(policy), robots, jax.random.fold_in(own_key, jax.process_index()))
        return robots, jax.tree.map(everyones, lived)

    specs: dict[str, Any] = {"in_specs": (_SAME, _STEPS_AND_ROBOTS, _SAME), "out_specs": _SAME, "check_vma": False}
    return collect_share, jax.shard_map(partial(update, axis_name=AXIS), mesh=mesh, **specs)


def shares(robots: T, key: Key[Array, ""], count: int) -> list[tuple[T, Key[Array, ""]]]:
    """The robots and the key of each of the `count` devices in `on_all`, or processes in `on_hosts`.

    They are for this process alone; every process must call it.
    """
    whole = gather(robots)
    return [(jax.tree.map(partial(_share, count, i), robots, whole), jax.random.fold_in(key, i)) for i in range(count)]


def share_of_host(robots: T) -> T:
    """This process' share of all robots on the host."""
    split = partial(_share, jax.process_count(), jax.process_index())
    return jax.tree.map(split, robots, robots)


def own_copy(tree: T) -> T:
    """This process' copy of arrays that are the same everywhere."""
    return jax.tree.map(lambda x: x.addressable_data(0), tree)


def gather(tree: T) -> T:
    """Arrays that every process can read to the end; every process must call it.

    What spans all processes is whole then, and so are robots of which each process has a share.
    """
    return tree if jax.process_count() == 1 else jax.tree.map(_gathered, tree)


def _gathered(leaf: Any) -> np.ndarray:
    if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable:
        return multihost_utils.process_allgather(leaf, tiled=True)
    own = np.asarray(leaf)
    if not own.size:
        return np.concatenate([own] * jax.process_count())
    # Byte by byte, for JAX would make float32 of float64.
    whole = multihost_utils.process_allgather(np.frombuffer(own.tobytes(), np.uint8))
    return np.frombuffer(whole.tobytes(), own.dtype).reshape(-1, *own.shape[1:])


def _share(count: int, i: int, like: Any, whole: Any) -> Any:
    """The `i`-th of `count` equal parts, an array of the library that `like` is of."""
    rows = np.split(np.asarray(whole), count)[i]
    return rows if isinstance(like, np.ndarray) else jnp.asarray(rows)


def _mesh() -> Mesh:
    return jax.make_mesh((jax.device_count(),), (AXIS,), axis_types=(AxisType.Auto,))


def _one_a_process() -> Mesh:
    first = {device.process_index: device for device in reversed(jax.devices())}
    return Mesh(np.array([first[i] for i in range(jax.process_count())]), (AXIS,), axis_types=(AxisType.Auto,))
