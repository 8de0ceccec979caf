"""The ground: hills z = h sin x, slopes, steps and rough ground, x along the walk; for NumPy and JAX arrays alike."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from operator import itemgetter
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from cassie_mjx.robot.arrays import Array, namespace

START_X_M = math.pi / 2
"""Where robots start on ground that is not flat, m: a crest of sin x is level; elsewhere a foot would start inside."""
LEVEL_M = 1.0
"""How far around the start slopes, steps and rough ground have not begun yet, m; over the next metre they grow."""
TREAD_M = 0.7
"""Length of a step, m: one is level with the start, the next is higher, and so on."""
ROUGH_SEEDS = 16
"""Rough grounds to choose from."""
_WAVES_PER_GROUND, _WAVELENGTHS_M = 12, (0.45, 0.75)

SCENES = ("flat", "terrain", "rough")
"""Scenes, each with all the ground of those before it."""

HIGHEST = {"sine": 1.0, "slope": 0.6, "across": 0.6, "steps": 0.5, "rough": 0.5}
"""The kinds of terrain, and the highest level of each, m or rad: "slope" rises along the walk, "across" to the left."""


class Terrain(NamedTuple):
    """Ground of one kind."""

    kind: str = "sine"
    """One of `HIGHEST`."""
    level: float = 0.0
    """Height, m, or angle, rad, of a slope, where below 0 is downhill or to the right; 0 is flat."""
    seed: int = 0
    """Which of the rough grounds."""

    @property
    def ground(self) -> "Ground":
        """Of one robot, its fields scalars."""
        return jax.tree.map(itemgetter(0), Ground.of([self]))


FLAT = Terrain()


def parse_terrain(text: str) -> Terrain:
    """The terrain of a command line: "0.2" is hills z = 0.2 sin x, "steps:0.1" another kind at its level.

    Raises:
      ValueError: there is no such kind, or its level is out of range.
    """
    kind, _, level = text.rpartition(":")
    kind = kind or "sine"
    if kind not in HIGHEST:
        raise ValueError(f"terrain={text} is not known; choose one of {', '.join(HIGHEST)}, as in steps:0.1.")
    highest = HIGHEST[kind]
    lowest = -highest if kind in ("slope", "across") else 0.0
    try:
        value = float(level)
    except ValueError:
        value = math.nan
    if not lowest <= value <= highest:
        raise ValueError(
            f"terrain={text} must have a level from {lowest:g} to {highest:g}, as in {kind}:{highest / 2:g}."
        )
    return Terrain(kind, value)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ground:
    """The ground of each robot: the sum of what its fields say, each [...] unless said otherwise.

    Attributes:
      sine: h of the hills z = h sin x, m.
      slope: how steep it is along x and along y, [..., 2], rad; above 0 it rises ahead and to the left.
      steps: height of every other step of 0.7 m, m.
      rough: band that 95% of the heights of smooth noise with bumps of 0.3 m lie in, m.
      seed: which of the `ROUGH_SEEDS` rough grounds, int32.
    """

    sine: Array
    slope: Array
    steps: Array
    rough: Array
    seed: Array

    @classmethod
    def flat(cls, *shape: int) -> "Ground":
        """Flat ground for robots [shape]."""
        zeros = np.zeros(shape)
        return cls(zeros, np.zeros((*shape, 2)), zeros, zeros, np.zeros(shape, np.int32))

    @classmethod
    def of(cls, terrains: Sequence[Terrain]) -> "Ground":
        """Robots on terrains, [B]."""
        level = {kind: np.array([each.level * (each.kind == kind) for each in terrains], float) for kind in HIGHEST}
        slope = np.stack([level.pop("slope"), level.pop("across")], axis=1)
        return cls(**level, slope=slope, seed=np.array([each.seed for each in terrains], np.int32))

    @property
    def uneven(self) -> Array:
        """Where it is not flat, [...], bool."""
        return (self.sine != 0) | (self.slope != 0).any(axis=-1) | (self.steps != 0) | (self.rough != 0)

    @property
    def scene(self) -> str:
        """The least scene of MuJoCo C that has the ground of all robots."""
        if np.any(self.rough):
            return "rough"
        return "terrain" if np.any(self.uneven) else "flat"


def height_below(ground: Ground, x: Array, y: Array) -> Array:
    """Height of the `Ground` [...] at x and y [...], m."""
    return smooth_height_below(ground, x, y) + ground.rough * _roughness(ground.seed, x, y)


def smooth_height_below(ground: Ground, x: Array, y: Array) -> Array:
    """The same less its roughness."""
    xp = namespace(ground.sine, x)
    ahead = x - START_X_M
    way = abs(ahead)
    begun = (way - LEVEL_M).clip(0, 1)
    # The slope itself grows over a metre: its integral is a parabola, then a line.
    climbed = xp.sign(ahead) * (begun**2 / 2 + (way - LEVEL_M - 1).clip(0))
    rise = xp.tan(ground.slope)
    tread = ((way - LEVEL_M) // TREAD_M + 1).clip(0) % 2
    return ground.sine * xp.sin(x) + rise[..., 0] * climbed + rise[..., 1] * begun * y + ground.steps * tread


def _roughness(seed: Array, x: Array, y: Array) -> Array:
    """Height of ground that is rough by 1 m, [...], m: waves in all directions, of standard deviation 1/4 m."""
    xp = namespace(seed, x)
    along_x, along_y, phase = xp.moveaxis(xp.asarray(WAVES, dtype=x.dtype)[seed], -1, 0)
    waves = xp.sin(along_x * x[..., None] + along_y * y[..., None] + phase)
    begun = (abs(x - START_X_M) - LEVEL_M).clip(0, 1)
    return begun * math.sqrt(2 / _WAVES_PER_GROUND) / 4 * waves.sum(axis=-1)


@lru_cache(maxsize=ROUGH_SEEDS)
def _rough_field(seed: int, x: tuple[float, float, int], y: tuple[float, float, int]) -> np.ndarray:
    """`_roughness` on a grid of evenly spaced x and y (first, last, number), [y, x], m."""
    return _roughness(np.asarray(seed), *np.meshgrid(np.linspace(*x), np.linspace(*y)))


def _draw_waves() -> np.ndarray:
    """What `WAVES` has, drawn with seed 0."""
    shape = (ROUGH_SEEDS, _WAVES_PER_GROUND)
    draw = np.random.default_rng(0)
    number = 2 * np.pi / draw.uniform(*_WAVELENGTHS_M, shape)
    direction, phase = draw.uniform(0, 2 * np.pi, (2, *shape))
    return np.stack([number * np.cos(direction), number * np.sin(direction), phase], axis=-1)


WAVES = _draw_waves()
"""Wave numbers along x and y (rad/m) and phase (rad) of the waves of each rough ground, [seed, wave, 3]."""


def scene_of(model: mujoco.MjModel) -> str:
    """Which of `SCENES` a model of MuJoCo C is of: the field of a terrain scene has two rows."""
    if not model.nhfield:
        return "flat"
    return "terrain" if model.hfield_nrow[0] == 2 else "rough"


def set_terrain(model: mujoco.MjModel, ground: Ground) -> None:
    """Write a ground into a scene's height field, in place.

    Args:
      model: a model of scene_terrain.xml, whose field has two rows, or of scene_rough.xml.
      ground: of one robot, its fields scalars.

    Raises:
      ValueError: the ground is rough, and the field has only two rows.
    """
    rows, columns = model.hfield_nrow[0], model.hfield_ncol[0]
    if ground.rough and scene_of(model) != "rough":
        raise ValueError(f"Ground with rough={ground.rough:g} needs the model with scene='rough'.")
    half_x, half_y = model.hfield_size[0, :2]
    floor = model.geom("floor").id
    middle_x, middle_y = model.geom_pos[floor, :2]
    x = (middle_x - half_x, middle_x + half_x, columns)
    y = (middle_y - half_y, middle_y + half_y, rows)
    kinds = {field.name: int if field.name == "seed" else float for field in fields(Ground)}
    each = Ground(**{name: np.asarray(getattr(ground, name), kind)[None, None] for name, kind in kinds.items()})
    z = smooth_height_below(each, np.linspace(*x), np.linspace(*y)[:, None])
    if ground.rough:
        z = z + float(ground.rough) * _rough_field(int(ground.seed), x, y)
    # MuJoCo wants a positive extent; a micrometre is flat.
    lowest, extent = z.min(), max(np.ptp(z), 1e-6)
    model.hfield_data[:] = ((z - lowest) / extent).ravel()
    model.hfield_size[0, 2] = extent
    model.geom_pos[floor, 2] = lowest
