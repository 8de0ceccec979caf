"""The compiled model against the published figures, and the ways a model can be wrong."""

import mujoco
import numpy as np
import pytest

from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import Terrain, set_terrain
from cassie_mjx.robot.loops import close_loops, loop_error
from cassie_mjx.robot.model import (
    CONTACTS,
    ModelConfig,
    load_mjx_model,
    load_model,
    servo_model,
    steps_per_control,
    xml_path,
)

HINGE_DEFAULTS = {"damping_Nms_per_rad": 0.0, "armature_kgm2": 0.0, "stiffness_Nm_per_rad": 0.0, "ref_deg": 0.0}


@pytest.fixture(scope="module")
def scene():
    return mujoco.MjModel.from_xml_path(str(xml_path("flat")))


def bodies(figures):
    return figures["bodies"]


def rotation(quat):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def test_sizes_and_total_mass(scene):
    assert (scene.nq, scene.nv, scene.nu, scene.neq) == (35, 32, 10, 4)
    assert scene.body_mass.sum() == pytest.approx(33.312, abs=1e-9)


def test_bodies_have_the_figures_masses_and_frames(scene, figures):
    assert [scene.body(i).name for i in range(1, scene.nbody)] == [body["name"] for body in figures["bodies"]]
    for figure in figures["bodies"]:
        body = scene.body(figure["name"])
        parent = scene.body(body.parentid[0]).name
        assert parent == figure["parent"]
        assert body.mass[0] == pytest.approx(figure["mass_kg"], abs=1e-12)
        np.testing.assert_allclose(body.ipos, figure["com"], atol=1e-12)
        np.testing.assert_allclose(body.pos, figure["pos"], atol=1e-12)
        x, y = np.reshape(figure.get("xyaxes", [1, 0, 0, 0, 1, 0]), (2, 3))
        x = x / np.linalg.norm(x)
        y = y - x * (x @ y)
        y /= np.linalg.norm(y)
        np.testing.assert_allclose(rotation(body.quat), np.stack([x, y, np.cross(x, y)], axis=1), atol=1e-12)


def test_bodies_have_the_figures_inertias(scene, figures):
    for figure in figures["bodies"]:
        body = scene.body(figure["name"])
        axes = rotation(body.iquat)
        xx, yy, zz, xy, xz, yz = figure["inertia_xx_yy_zz_xy_xz_yz"]
        expected = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        np.testing.assert_allclose(axes @ np.diag(body.inertia) @ axes.T, expected, atol=1e-9)


def test_joints_have_the_figures_properties(scene, figures):
    joints = [joint for figure in figures["bodies"][1:] for joint in figure.get("joints", [])]
    assert [scene.joint(i).name for i in range(1, scene.njnt)] == [joint["name"] for joint in joints]
    assert scene.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    for figure in joints:
        joint = scene.joint(figure["name"])
        wanted = HINGE_DEFAULTS | figure
        kind = mujoco.mjtJoint.mjJNT_BALL if figure["type"] == "ball" else mujoco.mjtJoint.mjJNT_HINGE
        assert joint.type[0] == kind
        np.testing.assert_allclose(joint.damping, wanted["damping_Nms_per_rad"], atol=1e-12)
        np.testing.assert_allclose(joint.armature, wanted["armature_kgm2"], atol=1e-12)
        np.testing.assert_allclose(joint.stiffness, wanted["stiffness_Nm_per_rad"], atol=1e-12)
        assert bool(joint.limited[0]) == ("range_deg" in figure)
        if "range_deg" in figure:
            np.testing.assert_allclose(joint.range, np.radians(figure["range_deg"]), atol=1e-12)
        if figure["type"] == "hinge":
            np.testing.assert_allclose(joint.axis, [0, 0, 1], atol=1e-12)
            np.testing.assert_allclose(joint.qpos0, np.radians(wanted["ref_deg"]), atol=1e-12)


def test_motors_have_the_figures_gears_and_limits(scene, figures):
    assert [scene.actuator(i).name for i in range(scene.nu)] == [figure["joint"] for figure in figures["actuators"]]
    for i, figure in enumerate(figures["actuators"]):
        motor = scene.actuator(figure["joint"])
        assert scene.joint(motor.trnid[0]).name == figure["joint"]
        assert motor.gear[0] == figure["gear"] == cassie.GEAR[i]
        np.testing.assert_allclose(motor.ctrlrange, [-figure["motor_torque_limit_Nm"], figure["motor_torque_limit_Nm"]])
        assert cassie.TORQUE_LIMIT[i] == pytest.approx(figure["joint_torque_limit_Nm"])
        assert cassie.TORQUE_LIMIT[i] == pytest.approx(figure["gear"] * figure["motor_torque_limit_Nm"])


def test_gains_are_the_published_ones(figures):
    gains = figures["pd_gains_joint_space"]
    for i, name in enumerate(cassie.ACTIVE * 2):
        assert cassie.P_GAIN[i] == gains["P_Nm_per_rad"][name]
        assert cassie.D_GAIN[i] == gains["D_Nms_per_rad"][name]


def test_loops_have_the_figures_anchors_and_close_at_the_reference(scene, figures):
    for i, figure in enumerate(figures["equality"]):
        assert scene.eq_type[i] == mujoco.mjtEq.mjEQ_CONNECT
        assert scene.body(scene.eq_obj1id[i]).name == figure["body1"]
        assert scene.body(scene.eq_obj2id[i]).name == figure["body2"]
        np.testing.assert_allclose(scene.eq_data[i, :3], figure["anchor_in_body1_m"], atol=1e-12)
        np.testing.assert_allclose(scene.eq_solref[i], figures["solver"]["contact_and_equality_solref"])
    assert loop_error(scene, scene.qpos0) < 1e-12


def test_collision_geoms_have_the_figures_shapes(scene, figures):
    for figure in figures["bodies"]:
        for shape in figure.get("collision", []):
            geom = scene.geom(figure["name"].removeprefix("cassie-") + "-collision")
            assert geom.size[0] == shape["radius_m"]
            if shape["type"] == "sphere":
                np.testing.assert_allclose(geom.pos, shape["pos"], atol=1e-12)
                continue
            start, end = np.reshape(shape["fromto"], (2, 3))
            np.testing.assert_allclose(geom.pos, (start + end) / 2, atol=1e-12)
            assert geom.size[1] == pytest.approx(np.linalg.norm(end - start) / 2)
            along = rotation(geom.quat)[:, 2]
            assert abs(along @ (end - start)) == pytest.approx(np.linalg.norm(end - start))


def test_sensors_and_sites_are_the_figures(scene, figures):
    found = [(scene.sensor(i).type[0], scene.sensor(i).noise[0], scene.sensor(i).user[0]) for i in range(scene.nsensor)]
    wanted = [
        (
            getattr(mujoco.mjtSensor, "mjSENS_" + f["kind"].upper()),
            f.get("noise_std", 0.0),
            f.get("encoder_bits", 0),
        )
        for f in figures["sensors"]
    ]
    assert found == wanted
    for figure in figures["bodies"]:
        for site in figure.get("sites", []):
            np.testing.assert_allclose(scene.site(site["name"]).pos, site["pos"], atol=1e-12)


def test_visual_geometry_weighs_nothing_and_touches_nothing(scene):
    for i in range(scene.ngeom):
        assert scene.geom_contype[i] == scene.geom_conaffinity[i] == 0
    assert load_model(ModelConfig()).body_mass.sum() == scene.body_mass.sum()
    np.testing.assert_array_equal(load_model(ModelConfig()).body_inertia, scene.body_inertia)


@pytest.mark.parametrize("contacts", CONTACTS)
def test_contacts_are_the_chosen_pairs(contacts):
    touching = {"walking": 2, "full": 16, "published": 18}
    assert load_model(ModelConfig(contacts=contacts)).npair == touching[contacts]
    assert load_mjx_model(ModelConfig(contacts=contacts)).npair == touching[contacts]


def test_published_contacts_are_all_that_the_figures_name(figures):
    """Everything in a group touches the floor; left legs touch right legs."""
    groups = {f["name"]: shape["group"] for f in figures["bodies"] for shape in f.get("collision", [])}
    wanted = {("floor", name.removeprefix("cassie-")) for name in groups}
    wanted |= {
        (a, b)
        for a, group_a in groups.items()
        for b, group_b in groups.items()
        if (group_a, group_b) == ("collision-left", "collision-right")
    }
    model = load_model(ModelConfig(contacts="published"))
    found = {tuple(model.pair(i).name.split(":")) for i in range(model.npair)}
    assert found == wanted


def test_standing_keeps_the_published_angles_and_closes_its_loops(model, standing_qpos, figures):
    published = figures["standing_active_joints_rad"]
    for name in ("hip-roll", "hip-yaw", "hip-pitch", "knee"):
        assert standing_qpos[cassie.qpos_index(f"left-{name}")[0]] == pytest.approx(published[name], abs=0.002)
    assert loop_error(model, standing_qpos) < 1e-4
    np.testing.assert_allclose(cassie.mirror_qpos(standing_qpos), standing_qpos, atol=1e-12)


def test_close_loops_finds_the_passive_joints_again(model, standing_qpos):
    rng = np.random.default_rng(0)
    qpos = standing_qpos.copy()
    passive = cassie.qpos_index("left-tarsus", "right-tarsus", "left-foot-crank", "right-plantar-rod")
    qpos[passive] += rng.uniform(-0.1, 0.1, 4)
    assert loop_error(model, qpos) > 1e-3
    closed = close_loops(model, qpos)
    assert loop_error(model, closed) < 1e-9
    np.testing.assert_array_equal(closed[cassie.ACTIVE_QPOS], qpos[cassie.ACTIVE_QPOS])


def test_close_loops_refuses_an_impossible_pose(model, standing_qpos):
    qpos = standing_qpos.copy()
    qpos[cassie.qpos_index("left-knee")] = np.pi
    with pytest.raises(ValueError, match="do not fit the mechanism"):
        close_loops(model, qpos)


def test_terrain_is_the_sine_everywhere():
    model = load_model(ModelConfig(scene="terrain"))
    set_terrain(model, Terrain("sine", 0.3).ground)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for x in np.random.default_rng(0).uniform(-9.5, 209.5, 50):
        origin = np.array([x, 3.0, 5.0])
        distance = mujoco.mj_rayHfield(model, data, model.geom("floor").id, origin, np.array([0.0, 0, -1]), None)
        assert 5.0 - distance == pytest.approx(0.3 * np.sin(x), abs=2e-4)


def test_terrain_reaches_further_than_the_longest_walk():
    """60 s at 4 times the reference's 0.500 m in 0.704 s, a tenth faster than told, from the crest at pi / 2."""
    terrain = mujoco.MjModel.from_xml_path(str(xml_path("terrain")))
    reach = terrain.geom("floor").pos[0] + terrain.hfield_size[0, 0]
    assert reach > np.pi / 2 + 1.1 * 60 * 4 * 0.5 / 0.704
    assert 2 * terrain.hfield_size[0, 0] / (terrain.hfield_ncol[0] - 1) == pytest.approx(0.05, abs=1e-12)


def test_servo_is_the_pd_law(model):
    servo = servo_model(model)
    data = mujoco.MjData(servo)
    rng = np.random.default_rng(1)
    data.qpos[:] = model.key("standing").qpos
    data.qvel[:] = rng.normal(size=cassie.NV)
    data.ctrl[:] = cassie.STANDING_TARGET + rng.normal(size=cassie.NU)
    mujoco.mj_forward(servo, data)
    torque = cassie.pd_torque(data.ctrl, data.qpos[cassie.ACTIVE_QPOS], data.qvel[cassie.ACTIVE_QVEL])
    assert (np.abs(torque) == cassie.TORQUE_LIMIT).any()
    np.testing.assert_allclose(data.qfrc_actuator[cassie.ACTIVE_QVEL], torque, atol=1e-12)
    assert model.actuator_gear[0, 0] == cassie.GEAR[0], "the original keeps its motors"


@pytest.mark.parametrize(("physics_hz", "steps"), [(500, 16), (1000, 32), (2000, 64)])
def test_physics_steps_in_a_control_step(physics_hz, steps):
    assert steps_per_control(physics_hz) == steps
    assert load_model(ModelConfig(physics_hz=physics_hz)).opt.timestep * steps == pytest.approx(0.032)


@pytest.mark.parametrize("physics_hz", [333, 1001])
def test_a_timestep_that_does_not_divide_the_control_step(physics_hz):
    with pytest.raises(ValueError, match="does not divide the control step of 32 ms.*use 500, 1000 or 2000"):
        ModelConfig(physics_hz=physics_hz)


@pytest.mark.parametrize("physics_hz", [0, -500, 1_000_000_000])
def test_a_timestep_that_no_walk_is_computed_with(physics_hz):
    with pytest.raises(ValueError, match=f"physics_hz={physics_hz} must be a whole number from 100 to 20,000."):
        ModelConfig(physics_hz=physics_hz)


def test_unknown_choices_name_the_known_ones():
    with pytest.raises(ValueError, match="scene=moon is not known; choose one of flat, terrain"):
        ModelConfig(scene="moon")
    with pytest.raises(ValueError, match="contacts=all is not known; choose one of walking, full, published"):
        ModelConfig(contacts="all")


def write_variant(tmp_path, change):
    """A copy of the robot's MJCF with one change."""
    for path in xml_path("flat").parent.glob("*.xml"):
        (tmp_path / path.name).write_text(change(path.read_text()) if path.name == "cassie.xml" else path.read_text())
    return tmp_path / "scene_flat.xml"


def test_a_model_without_a_joint(tmp_path):
    path = write_variant(tmp_path, lambda xml: xml.replace('name="left-shin" class', 'name="left-chin" class'))
    with pytest.raises(ValueError, match=r"lacks the joint left-shin; it has the joint left-chin instead"):
        load_model(ModelConfig(), path)


def test_a_file_that_is_no_model(tmp_path):
    path = write_variant(tmp_path, lambda xml: xml[: len(xml) // 2])
    with pytest.raises(ValueError, match="is not a model that MuJoCo reads"):
        load_model(ModelConfig(), path)
