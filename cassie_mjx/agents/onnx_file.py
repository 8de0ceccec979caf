"""A policy as an ONNX file: `python -m cassie_mjx.export policy=1x out=1x.onnx`.

Everything between a raw observation and the residuals is one graph, so that ONNX Runtime needs no code of ours. What
else a robot's program needs is in the file's metadata, as texts, which ONNX Runtime reads without another package; it
shows nobody a graph's initialisers, and an output would be handed over at every step. The keys are those of mjlab's
exporter and, for the rest, the names of `NumpyPolicy`; lists of numbers and names are separated by commas, nested ones
are JSON, and no digit is dropped.
"""

import json
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cassie_mjx.agents.numpy_policy import FORMAT, NumpyPolicy
from cassie_mjx.cli.origin import version_of
from cassie_mjx.control.network import KIND, Gru
from cassie_mjx.files.archive import VERSION
from cassie_mjx.files.atomic import write_bytes
from cassie_mjx.robot import cassie

OPSET, IR_VERSION = 17, 8
"""Of 2022: what any runtime of today reads."""

HIDDEN, NEXT = "hidden", "next_hidden"
"""What a recurrent policy is given of its last step, and gives for its next."""

PRODUCER = "cassie-mjx"
"""What a file says of who wrote it."""

USAGE = (
    "Every control_period_s, with k counted from 0 at the start of the walk, hold the joint targets "
    "reference_qpos[(k + 1) % N][reference_joint_columns] + action, in rad, in the order of joint_names, under "
    "torque = joint_stiffness (target - angle) - joint_damping velocity, at most joint_effort_limit. default_joint_pos "
    "is where the motion begins and no part of the target. The observation is as sensed, neither normalised, mirrored "
    "nor made noisy; 'observation' lists it, the reference in it being that of k + 1. A term of several control steps "
    "is stacked newest first by the caller. Pelvis x of the reference gains reference_stride_length every N steps. "
    "A policy that learned several speeds is told one by stretching the reference's pelvis x and its velocity. "
    "One that learned to be steered ('commands': least and greatest forward and lateral velocity, m/s, and yaw rate, "
    "rad/s, left positive) has the lateral velocity added to the reference's pelvis y velocity and the yaw rate about "
    "the vertical to its angular velocity; position, orientation and velocity of the robot's pelvis are then those in "
    "the frame of a path that the yaw rate turns about the robot and that the lateral velocity moves to the left. "
    "Where there is an input 'hidden', it is 0 as a walk begins, and from then on 'next_hidden' of the last step."
)


def save_onnx(path: Path, policy: NumpyPolicy, source: str) -> None:
    """Write a policy as ONNX, whole or not at all: `observation` [batch, O] to `action` [batch, 10], both float32.

    A recurrent policy's file has `hidden` [batch, N] besides and gives `next_hidden`.

    Args:
      path: ends in .onnx.
      policy: what to write.
      source: what the file's `run_path` says.

    Raises:
      ValueError: onnx is not installed, or the policy drives joints that this version's robot has not.
      OSError: it cannot be written.
    """
    onnx = _import_onnx()
    if KIND != "perceptron, ReLU":
        raise ValueError(f"An ONNX file can be a perceptron, ReLU; teach `_network` of this module a {KIND}.")
    model = onnx.helper.make_model(
        _graph(onnx, policy),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name=PRODUCER,
        producer_version=version_of("cassie-mjx"),
        doc_string=USAGE,
    )
    onnx.helper.set_model_props(model, metadata(policy, source))
    onnx.checker.check_model(model, full_check=True)
    write_bytes(path, model.SerializeToString())


def metadata(policy: NumpyPolicy, source: str) -> dict[str, str]:
    """What an ONNX file says of itself, by key.

    Raises:
      ValueError: the policy drives joints that this version's robot has not.
    """
    columns = cassie.qpos_index(*policy.joints)
    limits = dict(zip(cassie.ACTUATORS, cassie.TORQUE_LIMIT.tolist(), strict=True))
    return {
        "run_path": source,
        "joint_names": _listed(policy.joints),
        "joint_stiffness": _listed(policy.p_gain.tolist()),
        "joint_damping": _listed(policy.d_gain.tolist()),
        "joint_effort_limit": _listed(limits[name] for name in policy.joints),
        "default_joint_pos": _listed(policy.reference_qpos[0, columns].tolist()),
        "command_names": "",
        "observation_names": _listed(_plain_name(line) for line in policy.observation),
        "action_scale": _listed([1.0] * len(policy.joints)),
        "observation": json.dumps(policy.observation),
        "control_period_s": repr(cassie.CONTROL_PERIOD_S),
        "speed": repr(policy.speed),
        "commands": json.dumps(None if policy.commands is None else policy.commands.tolist()),
        "reference_qpos": json.dumps(policy.reference_qpos.tolist()),
        "reference_qvel": json.dumps(policy.reference_qvel.tolist()),
        "reference_stride_length": repr(policy.reference_stride_length),
        "reference_joint_columns": _listed(columns.tolist()),
        "reference_joints": json.dumps([{"name": name, "qpos": nq, "qvel": nv} for name, nq, nv in cassie.JOINTS]),
        "usage": USAGE,
        "format": FORMAT,
        "version": str(VERSION),
        "provenance": json.dumps(dict(policy.provenance)),
    }


def _import_onnx() -> Any:
    try:
        import onnx
    except ImportError as error:
        raise ValueError("An .onnx file needs the package onnx; pip install 'cassie-mjx[onnx]'.") from error
    return onnx


def _listed(values: Iterable[Any]) -> str:
    return ",".join(map(str, values))


def _plain_name(line: str) -> str:
    """The name of a term, without commas: "0:2 robot pelvis y, z (world) [m]" is "robot pelvis y z"."""
    name = line.partition(" ")[2].rpartition(" [")[0].partition(" (")[0].partition(":")[0]
    return name.replace(",", "")


class _Graph:
    """Nodes and constants in the order that they are added."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, name: str, values: Any, kind: type = np.float32) -> str:
        self.constants.append(self._onnx.numpy_helper.from_array(np.asarray(values, kind), name))
        return name

    def add(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(self._onnx.helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def columns(self, values: str, places: np.ndarray, output: str) -> str:
        """The columns `places`, counted from 0."""
        return self.add("Gather", [values, self.constant(f"{output}_places", places, np.int64)], output, axis=1)

    def reflected(self, values: str, reflection: np.ndarray, output: str) -> str:
        """As in the mirror that `Mirror` describes."""
        permuted = self.columns(values, abs(reflection) - 1, f"{output}_permuted")
        return self.add("Mul", [permuted, self.constant(f"{output}_sign", np.sign(reflection))], output)


def _graph(onnx: Any, policy: NumpyPolicy) -> Any:
    graph, mirror, cell = _Graph(onnx), policy.mirror, policy.gru
    if mirror is None:
        _network(graph, policy, "observation", "action")
    else:
        left, right = (graph.columns("observation", mirror.sides[i : i + 1] - 1, f"side_{i}") for i in (0, 1))
        second = graph.add("Less", [left, right], "second_step")
        image = graph.reflected("observation", mirror.observation, "observation_image")
        canonical = graph.add("Where", [second, image, "observation"], "canonical_observation")
        learned = _network(graph, policy, canonical, "canonical_action")
        action_image = graph.reflected(learned, mirror.action, "action_image")
        graph.add("Where", [second, action_image, learned], "action")
    taken, given = {"observation": len(policy.mean)}, {"action": len(policy.joints)}
    if cell is not None:
        taken, given = (sizes | {name: len(cell.recurrent_bias)} for sizes, name in ((taken, HIDDEN), (given, NEXT)))
    tensor = partial(onnx.helper.make_tensor_value_info, elem_type=onnx.TensorProto.FLOAT)
    ends = [[tensor(name, shape=["batch", size]) for name, size in each.items()] for each in (taken, given)]
    return onnx.helper.make_graph(graph.nodes, "policy", *ends, graph.constants)


def _network(graph: _Graph, policy: NumpyPolicy, x: str, output: str) -> str:
    """`control.network.action`: normalise, bound, the memory if there is one, the perceptron, tanh."""
    x = graph.add("Sub", [x, graph.constant("mean", policy.mean)], "centred")
    x = graph.add("Div", [x, graph.constant("std", policy.std)], "scaled")
    bounds = [graph.constant("lowest", -policy.clip), graph.constant("highest", policy.clip)]
    x = graph.add("Clip", [x, *bounds], "normalised")
    if policy.gru is not None:
        x = _remembered(graph, policy.gru, x)
    for i, (weight, bias) in enumerate(policy.weights):
        parameters = [graph.constant(f"weight_{i}", weight), graph.constant(f"bias_{i}", bias)]
        x = graph.add("Gemm", [x, *parameters], f"layer_{i}")
        if i < len(policy.weights) - 1:
            x = graph.add("Relu", [x], f"hidden_{i}")
    return graph.add("Tanh", [x], output)


def _remembered(graph: _Graph, gru: Gru, x: str) -> str:
    """`control.network.remember`: ONNX's GRU for one step, in one direction."""
    size = len(gru.recurrent_bias)
    first = graph.constant("first_axis", [0], np.int64)
    sequence, carried = (graph.add("Unsqueeze", [each, first], f"{each}_of_one") for each in (x, HIDDEN))
    weights = [
        graph.constant(f"gru_{name}", matrix.T[None])
        for name, matrix in (("kernel", gru.kernel), ("recurrent", gru.recurrent))
    ]
    # The gates' second biases are 0: they would only add to the first.
    bias = graph.constant("gru_bias", np.concatenate([gru.bias, np.zeros(2 * size), gru.recurrent_bias])[None])
    inputs = [sequence, *weights, bias, "", carried]
    given = graph.add("GRU", inputs, "gru", hidden_size=size, linear_before_reset=1)
    return graph.add("Squeeze", [given, graph.constant("sequence_and_direction", [0, 1], np.int64)], NEXT)
