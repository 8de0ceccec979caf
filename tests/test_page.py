"""The page in a browser: its JavaScript against the NumPy law and MuJoCo C, under Node."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from seeing import REMEMBERED, SENSORS, save_sensing_policy

from cassie_mjx import export
from cassie_mjx.agents import web_file
from cassie_mjx.agents.controller import Controller
from cassie_mjx.agents.shipped import existing_policy
from cassie_mjx.control.command import toward
from cassie_mjx.control.law import ControlLaw, canonicalize, decanonicalize, second_step
from cassie_mjx.control.network import action
from cassie_mjx.control.observation import OBSERVATIONS, Observation, Seen
from cassie_mjx.control.path import Path as WalkedPath
from cassie_mjx.control.step import begin, policy_step
from cassie_mjx.export import ExportConfig
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.reference import mean_speed, sample
from cassie_mjx.physics.native import NativePhysics
from cassie_mjx.physics.types import Scenario, sensed
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import HIGHEST, START_X_M, Ground, Terrain, height_below
from cassie_mjx.robot.model import ModelConfig, load_model, xml_path
from cassie_mjx.robot.rotation import turned, yaw

PAGE = Path(__file__).parents[1] / "page"
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="no Node here (apt-get install nodejs)")
TOLERANCE = 1e-5
COMMANDS = {0: (0.71, 0, 0, 0), 40: (1.5, 0.2, 0.5, 0), 120: (0.5, -0.3, -0.8, 0), 170: (0, 0, 0, 0), 220: (0, 0, 0, 1)}
"""Targets of a walk, by the control step that each begins at."""


def node(program, content):
    """What a program of `page/check` makes of a JSON."""
    assert NODE
    done = subprocess.run(
        [NODE, str(PAGE / "check" / program)], input=json.dumps(content), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


UNTRAINED = {
    "sensors": {},
    "sensors_history": {"terms": REMEMBERED},
    "recurrent": {"bias": 0.1, "network": "gru", "hidden_sizes": (24, 16)},
}
"""Policies of random weights that need what Cassie senses alone."""


@pytest.fixture(scope="module", params=["joystick", "1x-robust", "any", *UNTRAINED])
def name(request, tmp_path_factory):
    """Of a policy that ships, or the file of one of `UNTRAINED`."""
    if request.param not in UNTRAINED:
        return request.param
    path = tmp_path_factory.mktemp("policy") / f"{request.param}.npz"
    save_sensing_policy(path, **UNTRAINED[request.param])
    return str(path)


@pytest.fixture(scope="module")
def exported(name, tmp_path_factory):
    folder = tmp_path_factory.mktemp("web")
    export.main(ExportConfig(policy=name, web=str(folder)))
    return folder / f"{Path(name).stem}.json"


@pytest.fixture(scope="module")
def controller(name):
    return Controller.load(name)


def random_states(rng, controller, robots):
    """States around the reference motion, [B, 35] and [B, 32], their pelvis turned any way and of any sign."""
    qpos, qvel = (np.array(part) for part in sample(controller.motion, rng.integers(0, 22, robots)))
    qpos += rng.normal(0, 0.1, qpos.shape)
    qpos[:, :2] += rng.normal(0, 5, (robots, 2))
    turned = rng.normal(size=(robots, 4))
    qpos[:, 3:7] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return qpos, qvel + rng.normal(0, 1, qvel.shape)


def random_commands(rng, robots):
    """Commands of any kind, standing ones and those half way to standing among them."""
    velocities = rng.uniform(*np.array([(-0.7, 2.8), (-0.4, 0.4), (-0.8, 0.8)]).T, (robots, 3))
    stand = np.repeat([0.0, 0.3, 1.0], [robots - 20, 10, 10])
    still = (stand > 0) | (rng.uniform(size=robots) < 0.3)
    return Command(*np.where(still, 0.0, velocities.T), stand=stand)


def of(state, k):
    return {"qpos": state[0][k].tolist(), "qvel": state[1][k].tolist()}


def told(command, k):
    names = ("forward", "lateral", "yawRate", "stand")
    return {name: float(part[k]) for name, part in zip(names, command, strict=True)}


def close(found, key, expected):
    np.testing.assert_allclose([each[key] for each in found], expected, rtol=0, atol=TOLERANCE)


@needs_node
def test_observation_mirror_network_and_torque_are_numpys(exported, controller):
    rng, policy, law = np.random.default_rng(0), controller.policy, controller.law
    state = random_states(rng, controller, 100)
    reference = sample(controller.motion, rng.integers(0, 44, 100))
    states = [{"state": of(state, k), "reference": of(reference, k)} for k in range(100)]
    found = node("control.mjs", {"policy": str(exported), "observed": states, "steps": [], "walk": [], "heights": []})
    seen, network = Seen(*state, *reference), policy.network
    observation, _ = law.observation.update(law.init(seen), seen)
    close(found["observed"], "observation", observation)
    close(found["observed"], "mirrored", law.observation.mirrored(observation))
    close(found["observed"], "action", action(network, observation, policy.start(100))[0])
    second = second_step(reference[0]) & law.symmetric
    assert second.any() == law.symmetric
    acts, _ = action(network, canonicalize(law.observation, observation, second), policy.start(100))
    close(found["observed"], "residual", decanonicalize(acts, second))
    q, qdot = state[0][:, cassie.ACTIVE_QPOS], state[1][:, cassie.ACTIVE_QVEL]
    torque = policy.p_gain * (reference[0][:, :10] - q) - policy.d_gain * qdot
    close(found["observed"], "torque", torque.clip(-cassie.TORQUE_LIMIT, cassie.TORQUE_LIMIT))


@needs_node
def test_a_control_step_is_numpys(exported, controller):
    rng, policy, motion = np.random.default_rng(1), controller.policy, controller.motion
    qpos, qvel = random_states(rng, controller, 100)
    # Half of them slow enough to stand.
    qvel[::2, :2] *= 0.1
    command, target, time = random_commands(rng, 100), random_commands(rng, 100), rng.integers(0, 22, 100)
    place = rng.normal(0, 3, (3, 100))
    carries = [
        {"time": int(time[k]), "path": dict(zip(("x", "y", "heading"), place[:, k], strict=True))} for k in range(100)
    ]
    steps = [
        {"carry": carries[k] | {"command": told(command, k)}, **of((qpos, qvel), k), "target": told(target, k)}
        for k in range(100)
    ]
    found = node("control.mjs", {"policy": str(exported), "observed": [], "steps": steps, "walk": [], "heights": []})
    now = toward(motion, command, target, time, qvel)
    network = policy.network
    before = begin(controller.law, motion, network, time, qpos, qvel)._replace(path=WalkedPath(*place))
    targets, after = policy_step(controller.law, motion, network, before, qpos, qvel, now)
    close(found["steps"], "targets", targets)
    carry = [step["carry"] for step in found["steps"]]
    close(carry, "time", after.time)
    np.testing.assert_allclose(
        [list(each["path"].values()) for each in carry], np.transpose(after.path), atol=TOLERANCE
    )
    np.testing.assert_allclose([list(each["command"].values()) for each in carry], np.transpose(now), atol=TOLERANCE)


@pytest.fixture(scope="module")
def walk(controller, name):
    """A walk in plain MuJoCo under `COMMANDS`: states and targets of 300 control steps, or until it has fallen."""
    model = mujoco.MjModel.from_xml_path(str(xml_path("flat")))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = controller.initial_state(data.qpos, data.qvel)
    controller.reset()
    steps, command = [], COMMANDS[0]
    for k in range(300):
        command = COMMANDS.get(k, command)
        target = "stand" if command == (0, 0, 0, 1) else command[:3]
        steps.append((data.qpos.copy(), data.qvel.copy(), command, controller(data.qpos, data.qvel, target)))
        for _ in range(64):
            torque = controller.torque(steps[-1][3], data.qpos, data.qvel)
            data.ctrl[:] = torque / cassie.GEAR
            mujoco.mj_step(model, data)
    return steps


@needs_node
def test_a_walk_of_300_steps_is_numpys(exported, walk):
    content = [
        {"qpos": qpos.tolist(), "qvel": qvel.tolist(), "target": told(np.array(command)[:, None], 0)}
        for qpos, qvel, command, _ in walk
    ]
    found = node("control.mjs", {"policy": str(exported), "observed": [], "steps": [], "walk": content, "heights": []})
    close(found["walk"], "targets", [targets for *_, targets in walk])
    assert found["walk"][160]["carry"]["path"]["heading"] != 0
    assert max(each["carry"]["command"]["stand"] for each in found["walk"]) > 0


@needs_node
def test_the_ground_is_as_high_as_numpys(exported):
    rng = np.random.default_rng(2)
    places = rng.uniform(-10, 20, (200, 2)).tolist()
    terrains = [Terrain(kind, 0.7 * level, seed=3) for kind, level in HIGHEST.items()]
    wanted = [{"terrain": each._asdict(), "x": x, "y": y} for each in terrains for x, y in places]
    found = node("control.mjs", {"policy": str(exported), "observed": [], "steps": [], "walk": [], "heights": wanted})
    x, y = np.tile(np.array(places).T, len(terrains))
    ground = Ground.of([each for each in terrains for _ in places])
    np.testing.assert_allclose(found["heights"], height_below(ground, x, y), rtol=0, atol=1e-9)


needs_packages = pytest.mark.skipif(
    NODE is None or not (PAGE / "node_modules" / "@mujoco").is_dir(), reason="no npm packages here (make site)"
)


def walk_in_c(controller, terrain, delay, push_n):
    """States every 16 ms of a walk of 1 s on `NativePhysics`, the same as `page/check/physics.mjs` has it, [62, 35]."""
    physics = NativePhysics(load_model(ModelConfig(scene=terrain.ground.scene)), max_delay=40, threads=1)
    qpos, qvel = (np.array(part[:1], float) for part in controller.motion[:2])
    ground = Ground.of([terrain])
    qpos[:, [cassie.PELVIS_X, cassie.PELVIS_Z]] += np.array([START_X_M * ground.uneven[0], ground.sine[0]])
    aside = turned(np.array([0.0, 1.0]), yaw(qpos[0, cassie.PELVIS_QUATERNION]))
    scenario = Scenario.nominal(
        1,
        ground=ground,
        kd_scale=controller.policy.d_gain[:1] / cassie.D_GAIN[0],
        delay=np.array([delay]),
        push=push_n * np.append(aside, 0.0)[None, None],
        push_stop=np.array([[400]]),
    )
    controller.reset()
    state, target, states = physics.init(qpos, qvel), np.zeros((1, 10)), []
    for sync in range(62):
        if sync % 2 == 0:
            seen_qpos, seen_qvel = sensed(state, scenario)
            target = controller(seen_qpos[0], seen_qvel[0], float(mean_speed(controller.motion)))[None]
        state = physics.advance(state, target, scenario, 32)
        states.append(state.qpos[0])
    return np.array(states)


@needs_packages
@pytest.mark.parametrize(
    ("terrain", "delay", "push_n", "syncs", "tolerance"),
    [
        (Terrain(), 0, 0.0, 62, 1e-9),
        (Terrain(), 20, 80.0, 62, 1e-9),
        (Terrain("steps", 0.05), 0, 80.0, 62, 1e-9),
        (Terrain("rough", 0.05, 3), 10, 0.0, 62, 1e-9),
        # The page's field is shorter, and its highest point another: float32 rounds heights otherwise, by 0.1 um, which
        # contacts enlarge, to 3 mrad after a second.
        (Terrain("sine", 0.2), 10, 0.0, 16, 1e-5),
    ],
)
def test_a_second_is_that_of_mujoco_c(exported, controller, terrain, delay, push_n, syncs, tolerance):
    content = {
        "policy": str(exported),
        "xml": str(xml_path().parent),
        "terrain": terrain._asdict(),
        "delaySteps": delay,
        "push": [push_n, [0, 1]],
        "syncs": syncs,
    }
    expected = walk_in_c(controller, terrain, delay, push_n)
    np.testing.assert_allclose(node("physics.mjs", content)["qpos"], expected[:syncs], rtol=0, atol=tolerance)


@needs_packages
def test_a_height_field_that_goes_along_changes_nothing(tmp_path):
    """20 s at 0.7 m/s are farther than it reaches at first."""
    export.main(ExportConfig(policy="joystick", web=str(tmp_path)))
    content = {"policy": str(tmp_path / "joystick.json"), "xml": str(xml_path().parent), "delaySteps": 0, "syncs": 1250}
    found = node("physics.mjs", content | {"terrain": Terrain("steps", 0.02)._asdict()})
    assert found["falls"] == 0
    assert found["qpos"][-1][0] > 11


def test_the_page_has_a_policy_of_each_kind_of_place(tmp_path, capsys):
    run = tmp_path / "runs" / "mine"
    run.mkdir(parents=True)
    (run / "config.json").write_text("{}")
    (run / "best.npz").write_bytes(existing_policy("1x").read_bytes())
    for _ in range(2):
        export.main(ExportConfig(run=str(run), web=str(tmp_path)))
    assert json.loads((tmp_path / "mine.json").read_text())["name"] == "mine"
    assert "mine.json: return_plain" in capsys.readouterr().out
    (tmp_path / "1x.json").write_text('{"notes": "mine"}')
    with pytest.raises(ValueError, match=r"1x\.json exists and is not a policy of ours for the page"):
        export.main(ExportConfig(policy="1x", web=str(tmp_path)))
    for out, web in ((None, None), ("a.npz", ".")):
        with pytest.raises(ValueError, match="Either out or web must be given"):
            ExportConfig(policy="1x", out=out, web=web)


def test_a_network_that_the_page_has_not_is_refused(monkeypatch):
    monkeypatch.setattr(web_file, "KIND", "perceptron, ELU")
    with pytest.raises(ValueError, match=r"teach `page/src/control/network\.js` a perceptron, ELU"):
        web_file.content(Controller.load("1x").policy, "1x")


def test_terms_that_the_page_cannot_compute_are_refused():
    first, *others = OBSERVATIONS["full"].terms
    squared = replace(first, compute=lambda seen: first.compute(seen) ** 2)
    with pytest.raises(ValueError, match="this one observes more; teach `page/src/control/law.js` its terms"):
        web_file.sources(ControlLaw(Observation((squared, *others))))


def test_the_page_is_told_what_was_seen_when():
    """Four frames of 41 numbers, the oldest last in each term, then the reference of now."""
    place, age = web_file.sources(ControlLaw(REMEMBERED))
    *robot, reference = np.split(age, np.cumsum([16, 12, 56, 56, 24]))
    for term, size in zip(robot, (4, 3, 14, 14, 6), strict=True):
        np.testing.assert_array_equal(term, np.repeat(np.arange(4), size))
    assert len(reference) == REMEMBERED.size - 4 * 41
    assert not reference.any()
    np.testing.assert_array_equal(place[:16], np.tile(np.arange(3, 7), 4))
    # After qpos and qvel of robot and reference.
    np.testing.assert_array_equal(place[140:164], np.tile(np.arange(134, 140), 4))
    assert not web_file.sources(ControlLaw(SENSORS)).age.any()


def test_the_guide_links_to_where_the_page_is_built():
    root = PAGE.parent
    assert "node page/build.mjs page/build docs/drive\n" in (root / "Makefile").read_text()
    for page, link in (("index", "drive/index.html"), ("browser", "../drive/index.html")):
        assert f'href="{link}"' in (root / "docs" / f"{page}.md").read_text()
