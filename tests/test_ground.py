"""The ground: its heights by hand, the same in the height field, on both engines and in training."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from points import Still

from cassie_mjx.envs.scenario import TRAINING_SEEDS, ScenarioConfig, draw_scenario
from cassie_mjx.evaluation import suites
from cassie_mjx.physics.mjx import MjxPhysics
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import FLAT, HIGHEST, START_X_M, Ground, Terrain, height_below, parse_terrain, set_terrain
from cassie_mjx.robot.model import MJX_TRAINING, ModelConfig, load_mjx_model, load_model

KINDS = [Terrain("sine", 0.2), Terrain("slope", -0.2), Terrain("across", 0.15), Terrain("steps", 0.1)]
ROUGH = Terrain("rough", 0.1, seed=3)


def heights(terrain, ahead, y=0.0):
    x = START_X_M + np.asarray(ahead, float)
    return height_below(Ground.of([terrain] * len(x)), x, np.full(len(x), y))


def test_ground_is_level_for_a_metre_around_the_start():
    near = np.linspace(-0.99, 0.99, 45)
    for terrain in (*KINDS[1:], ROUGH):
        np.testing.assert_array_equal(heights(terrain, near, 0.3), 0)
    np.testing.assert_allclose(heights(KINDS[0], [0, np.pi / 2, np.pi]), [0.2, 0, -0.2], atol=1e-12)


def test_slopes_grow_over_a_metre_and_go_on():
    # Half a metre of a full slope has been climbed when it is full, two metres ahead.
    up, way = Terrain("slope", 0.2), np.array([0.5, 1.5, 10.5, -0.5, -10.5])
    np.testing.assert_allclose(heights(up, [2, 3, 12, -2, -12]), np.tan(0.2) * way)
    across = Terrain("across", 0.2)
    np.testing.assert_allclose(heights(across, [1.5, 2, 9], 0.4), np.tan(0.2) * 0.4 * np.array([0.5, 1, 1]))
    np.testing.assert_allclose(heights(across, [2], -0.4), -0.4 * np.tan(0.2))


def test_every_other_step_is_higher():
    ahead = [0.99, 1.01, 1.69, 1.71, 2.39, 2.41, -1.01, -1.71]
    np.testing.assert_allclose(heights(Terrain("steps", 0.1), ahead), [0, 0.1, 0.1, 0, 0, 0.1, 0.1, 0], atol=1e-12)


def test_rough_ground_has_its_band_and_bumps_of_a_third_of_a_metre():
    draw = np.random.default_rng(0)
    ahead, y = draw.uniform(2, 60, 20_000), draw.uniform(-3, 3, 20_000)
    every = [height_below(Ground.of([Terrain("rough", 0.1, seed)] * len(y)), START_X_M + ahead, y) for seed in (0, 5)]
    for z in every:
        assert np.mean(np.abs(z) < 0.05) == pytest.approx(0.95, abs=0.02)
    assert np.corrcoef(every)[0, 1] == pytest.approx(0, abs=0.05)
    line = heights(Terrain("rough", 0.1), np.linspace(2, 60, 5801))
    crossings = np.count_nonzero(np.diff(np.sign(line)))
    assert 0.25 < 58 / crossings < 0.55, "way from one bump to the next hollow, m, along a line"


def test_numpy_and_jax_agree():
    draw = np.random.default_rng(1)
    terrains = [*KINDS, ROUGH, FLAT]
    x, y = draw.uniform(-8, 60, (2, len(terrains)))
    ground = Ground.of(terrains)
    traced = jax.jit(height_below)(jax.tree.map(jnp.asarray, ground), jnp.asarray(x), jnp.asarray(y))
    np.testing.assert_allclose(traced, height_below(ground, x, y), atol=2e-5)


@pytest.mark.parametrize("terrain", [*KINDS, ROUGH], ids=lambda terrain: terrain.kind)
def test_the_height_field_is_the_ground(terrain):
    model = load_model(ModelConfig(scene=terrain.ground.scene))
    set_terrain(model, terrain.ground)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    draw = np.random.default_rng(2)
    missed = []
    for x, y in zip(draw.uniform(-8, 60, 60), draw.uniform(-2, 2, 60), strict=True):
        origin = np.array([x, y, 20.0])
        distance = mujoco.mj_rayHfield(model, data, model.geom("floor").id, origin, np.array([0.0, 0, -1]), None)
        missed.append(20 - distance - height_below(terrain.ground, np.float64(x), np.float64(y)))
    # A step rises from one column of the field to the next, 0.05 m of every 0.7 m; bumps are cut by triangles.
    allowed = {"rough": 0.005, "steps": 1e-4}.get(terrain.kind, 1e-3)
    assert np.mean(np.abs(missed) > allowed) <= (0.2 if terrain.kind == "steps" else 0)


def test_rough_ground_needs_its_scene():
    with pytest.raises(ValueError, match=r"rough=0.1 needs the model with scene='rough'"):
        set_terrain(load_model(ModelConfig(scene="terrain")), ROUGH.ground)


def test_both_engines_stand_on_the_same_ground(standing_qpos):
    terrains = [Terrain("slope", 0.2), Terrain("across", -0.2), Terrain("steps", 0.1), ROUGH]
    # Three metres ahead all has grown; the feet are on one tread.
    qpos = np.tile(standing_qpos, (len(terrains), 1))
    qpos[:, 0] = START_X_M + 2.75
    ground = Ground.of(terrains)
    qpos[:, 2] += height_below(ground, qpos[:, 0], qpos[:, 1]) + 0.03
    scenario = Scenario.nominal(len(terrains), ground=ground)
    targets = np.tile(cassie.STANDING_TARGET, (len(terrains), 1))
    hills = NativePhysics(load_model(ModelConfig(physics_hz=1000, scene="rough")))
    planes = MjxPhysics(load_mjx_model(replace(MJX_TRAINING, iterations=20, ls_iterations=20)))
    c = hills.advance(hills.init(qpos, np.zeros((len(terrains), cassie.NV))), targets, scenario, 192)
    x = planes.init(qpos.astype(np.float32), np.zeros((len(terrains), cassie.NV), np.float32))
    for _ in range(6):
        x = planes.advance(x, targets, scenario, 32)
    np.testing.assert_allclose(np.asarray(x.qpos)[:3, :3], c.qpos[:3, :3], atol=6e-3)
    # A bump under a toe is more than a plane under the foot can say.
    np.testing.assert_allclose(np.asarray(x.qpos)[3, :3], c.qpos[3, :3], atol=3e-2)


def test_training_draws_one_kind_an_episode():
    config = ScenarioConfig(terrain_m=0.4, slope_rad=0.3, steps_m=0.1, rough_m=0.08)
    assert config.scene == "rough"
    ground = jax.tree.map(np.asarray, draw_scenario(config, jax.random.key(0), 20_000, 500).ground)
    kinds = np.stack([ground.sine != 0, (ground.slope != 0).any(axis=1), ground.steps != 0, ground.rough != 0])
    assert kinds.sum(axis=0).max() == 1
    np.testing.assert_allclose(kinds.mean(axis=1), 8 / 9 / 4, atol=0.01)
    assert [len(set(level.tolist())) for level in (ground.sine, ground.steps, ground.rough)] == [9, 9, 9]
    np.testing.assert_allclose([ground.sine.max(), ground.steps.max(), ground.rough.max()], [0.4, 0.1, 0.08], rtol=1e-6)
    for side in range(2):
        np.testing.assert_allclose([ground.slope[:, side].min(), ground.slope[:, side].max()], [-0.3, 0.3], rtol=1e-6)
    assert set(ground.seed.tolist()) == set(range(TRAINING_SEEDS))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.2", Terrain("sine", 0.2)),
        ("steps:0.1", Terrain("steps", 0.1)),
        ("slope:-0.3", Terrain("slope", -0.3)),
        ("0", Terrain("sine", 0.0)),
    ],
)
def test_a_terrain_is_read_from_the_command_line(text, expected):
    assert parse_terrain(text) == expected


@pytest.mark.parametrize("text", ["moon:1", "steps:-0.1", "rough:x", "2", "slope:0.7", ""])
def test_a_terrain_that_is_none_gets_one_sentence(text):
    with pytest.raises(ValueError, match=r"^terrain=.*(choose one of|must have a level from).*\.$"):
        parse_terrain(text)


def test_the_suite_asks_for_each_kind(monkeypatch):
    asked = []

    def limits(lasting, agent, physics, starts, setup):
        asked.append((lasting.quantity, lasting.disturb(1)["terrain"], lasting.levels, physics, lasting.seconds))
        return []

    class Setup(suites.EvalSetup):
        def starts(self, agent, phases, longest_delay_s=0.0) -> Any:
            return None

        def physics(self, scene="flat", longest_delay_s=0.0) -> Any:
            return scene

    monkeypatch.setattr(suites, "_limits", limits)
    suites.ground(Still(), Setup())
    assert asked == [
        ("slope_up_max_rad", Terrain("slope", 0.05), 12, "terrain", 10),
        ("slope_down_max_rad", Terrain("slope", -0.05), 12, "terrain", 10),
        ("slope_across_max_rad", Terrain("across", 0.05), 12, "terrain", 10),
        ("steps_max_m", Terrain("steps", 0.01), 50, "terrain", 10),
        ("rough_max_m", Terrain("rough", 0.01), 50, "rough", 60),
    ]
    assert set(HIGHEST) == {"sine", *(terrain.kind for _, terrain, *_ in asked)}
