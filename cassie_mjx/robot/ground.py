"""The ground: terrain z = h sin x, x along the walk."""

import math

import mujoco
import numpy as np

from cassie_mjx.robot.arrays import Array, namespace

CREST_X_M = math.pi / 2
"""Where robots start on the terrain, m: a crest is level; elsewhere a foot would start inside the slope."""


def set_terrain(model: mujoco.MjModel, height: float) -> None:
    """Write the terrain z = h sin x into a terrain scene's height field, in place.

    Args:
      model: a model of scene_terrain.xml.
      height: h, m.

    Raises:
      ValueError: h is negative.
    """
    if height < 0:
        raise ValueError(f"The terrain's height is {height:g} m; it must be at least 0.")
    columns = model.hfield_ncol[0]
    radius = model.hfield_size[0, 0]
    floor = model.geom("floor").id
    x = model.geom_pos[floor, 0] + np.linspace(-radius, radius, columns)
    model.hfield_data[:] = np.tile((np.sin(x) + 1) / 2, model.hfield_nrow[0])
    # MuJoCo wants a positive extent; a micrometre is flat.
    model.hfield_size[0, 2] = max(2 * height, 1e-6)
    model.geom_pos[floor, 2] = -height


def height_below(ground: Array, x: Array) -> Array:
    """Height of the ground z = h sin x at `x`, m; `ground` is h, m, both [...]."""
    return ground * namespace(ground, x).sin(x)
