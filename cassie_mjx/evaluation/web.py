"""The live view in a browser: `python -m cassie_mjx.view policy=any web=true` serves one robot that all visitors share.

The page is viser's and its scene mjviser's. What a visitor does is heard in a thread of viser's: it leaves a wish,
which the loop that steps the robot fulfils.
"""

import logging
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence

import glfw
import numpy as np
import viser
from mjviser import ViserMujocoScene
from viser import uplot
from viser._messages import HotkeyKey

from cassie_mjx.evaluation.track import velocities
from cassie_mjx.evaluation.viewer import PUSH_N, SYNC_S, Live
from cassie_mjx.motion.command import Command
from cassie_mjx.motion.schedule import LIMITS
from cassie_mjx.robot.ground import HIGHEST, Terrain

PICTURE_SYNCS, PLOT_SYNCS = 2, 12
"""Syncs of 16 ms from one picture to the next, and from one point of the plots to the next."""
PLOTTED_S, PLOT_S = 12.0, PLOT_SYNCS * SYNC_S
COMPONENTS = ("forward, m/s", "left, m/s", "turn left, rad/s")
COMMANDS: dict[str, tuple[HotkeyKey, int]] = {
    "faster": ("arrowup", glfw.KEY_UP),
    "slower": ("arrowdown", glfw.KEY_DOWN),
    "turn left": ("arrowleft", glfw.KEY_LEFT),
    "turn right": ("arrowright", glfw.KEY_RIGHT),
    "to the left": ("delete", glfw.KEY_DELETE),
    "to the right": ("pagedown", glfw.KEY_PAGE_DOWN),
    "stop": ("end", glfw.KEY_END),
    "start anew": ("home", glfw.KEY_HOME),
    "push forward": ("6", glfw.KEY_6),
    "push backward": ("7", glfw.KEY_7),
    "push left": ("8", glfw.KEY_8),
    "push right": ("9", glfw.KEY_9),
}
"""What the keys of the window (`evaluation.keys`) do, their names in viser, and GLFW's numbers of them."""
PUSHES = ("forward", "backward", "left", "right")
TEXT = """All visitors drive this one robot.

Arrow keys steer, Delete and Page Down go sideways. End stops; pressed again, it stands. 6, 7, 8, 9 push, Home
starts anew.
"""
CAMERA_M = (1.6, -2.6, 0.7)
"""Where the camera begins, from the pelvis."""

Make = Callable[[str, Terrain], Live]
"""The robot of a policy's name on a terrain."""


class WebView:
    """A page with one robot, and the loop that it walks by."""

    def __init__(self, make: Make, policies: Sequence[str], terrain: Terrain, host: str, port: int) -> None:
        """Serve the page.

        Args:
          make: makes the robot, anew for each policy and terrain that a visitor chooses.
          policies: to choose from; it begins with the first.
          terrain: that it begins on.
          host: address to listen at.
          port: to listen at.

        Raises:
          ValueError: the port is in use, or not ours to use.
        """
        check_port(host, port)
        # Browsers open connections ahead and drop them unused; that is no error of anyone's.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        self.live, self._make = make(policies[0], terrain), make
        self._wishes: deque[Callable[[], None]] = deque()
        self.server = viser.ViserServer(host, port, label="Cassie MJX", verbose=False)
        self.server.on_client_connect(_place_camera)
        self.server.gui.main_panel.dock_right()
        self._show_scene()
        self.server.gui.add_markdown(TEXT)
        self._sliders = [self._add_slider(axis) for axis in range(len(COMPONENTS))]
        self._add_buttons()
        self._add_choosers(policies, terrain)
        self._plots = [self._add_plot(name) for name in COMPONENTS]
        self._plotted = np.zeros((0, 2 * len(COMPONENTS)))

    def run(self, seconds: float = np.inf) -> None:
        """Walk in real time, for ever or for some seconds. A robot that has fallen starts anew."""
        began = due = time.perf_counter()
        syncs = 0
        while due - began < seconds:
            while self._wishes:
                self._wishes.popleft()()
            self.live.sync()
            syncs += 1
            if syncs % PICTURE_SYNCS == 0:
                self.scene.update_from_mjdata(self.live.data)
            if syncs % PLOT_SYNCS == 0:
                self._plot()
            # A computer that is too slow shows slow motion and does not catch up.
            due = max(due + SYNC_S, time.perf_counter())
            time.sleep(max(due - time.perf_counter(), 0.0))

    def close(self) -> None:
        """Stop serving."""
        self.server.stop()

    def _show_scene(self) -> None:
        self.server.scene.reset()
        self.scene = ViserMujocoScene(self.server, self.live.model, num_envs=1)
        self.scene.update_from_mjdata(self.live.data)

    def _press(self, label: str) -> None:
        """Do what the key of a command does."""
        self.live.keys.append(COMMANDS[label][1])

    def _add_slider(self, axis: int) -> viser.GuiSliderHandle[float]:
        low, high = LIMITS[axis].tolist()
        slider = self.server.gui.add_slider(COMPONENTS[axis], low, high, 0.1, 0.0)

        @slider.on_update
        def _(event: viser.GuiEvent) -> None:
            # Without a visitor, it was moved by us, to where keys or another visitor have the target.
            if event.client is not None:
                self._wishes.append(lambda value=float(slider.value): self._steer(axis, value))

        return slider

    def _steer(self, axis: int, value: float) -> None:
        """Command a velocity, the others as they are."""
        now = self.live.target or self.live.command
        if now is not None:
            told = [value if k == axis else float(part) for k, part in enumerate(now[:3])]
            self.live.target = Command(*told, stand=0.0)

    def _add_buttons(self) -> None:
        gui = self.server.gui
        for label, (hotkey, _) in COMMANDS.items():
            gui.add_command(label, hotkey=hotkey).on_trigger(lambda _, label=label: self._press(label))
        gui.add_button_group("robot", ("stop", "stand", "start anew")).on_click(
            lambda event: self._stand() if event.target.value == "stand" else self._press(event.target.value)
        )
        gui.add_button_group("push", PUSHES).on_click(lambda event: self._press(f"push {event.target.value}"))
        force = gui.add_slider("its force, N", 10, 300, 10, PUSH_N)
        force.on_update(lambda _: setattr(self.live, "push_n", float(force.value)))

    def _stand(self) -> None:
        for _ in range(2):
            self._press("stop")

    def _add_choosers(self, policies: Sequence[str], terrain: Terrain) -> None:
        gui = self.server.gui
        policy = gui.add_dropdown("policy", policies)
        kind = gui.add_dropdown("ground", tuple(HIGHEST), initial_value=terrain.kind)
        level = gui.add_slider("its height, m, or angle, rad", 0, 0.5, 0.01, abs(terrain.level))

        def choose(_: viser.GuiEvent) -> None:
            chosen = policy.value, Terrain(kind.value, min(float(level.value), HIGHEST[kind.value]))
            self._wishes.append(lambda: self._begin(*chosen))

        gui.add_button("walk with this policy on this ground").on_click(choose)
        self._said = gui.add_markdown("")

    def _begin(self, policy: str, terrain: Terrain) -> None:
        """Another robot takes the place of this one."""
        self._said.content = f"{policy} is brought up to speed …"
        try:
            live = self._make(policy, terrain)
        except ValueError as error:
            self._said.content = str(error)
            return
        live.push_n, self.live = self.live.push_n, live
        self._show_scene()
        self._said.content = ""

    def _add_plot(self, title: str) -> viser.GuiUplotHandle:
        lines = ("", "#888"), ("commanded", "#888"), ("actual", "#06c")
        series = tuple(uplot.Series(label=label, stroke=colour) for label, colour in lines)
        axes = uplot.Axis(show=False), uplot.Axis(size=36)
        legend = uplot.Legend(show=False)
        return self.server.gui.add_uplot(
            (np.zeros(1),) * 3, series, title=title, axes=axes, scales={"x": {"time": False}}, legend=legend, height=110
        )

    def _plot(self) -> None:
        """Draw what is told and what is, of the last seconds, and put the sliders where the target is."""
        live = self.live
        told = live.command or Command(*[0.0] * 4)
        found = velocities(np.array([live.places]), SYNC_S)[0].mean(axis=0)
        row = np.concatenate([told[:3], found])[None]
        self._plotted = np.concatenate([self._plotted, row])[-round(PLOTTED_S / PLOT_S) :]
        seconds, target = PLOT_S * np.arange(1 - len(self._plotted), 1), live.target or told
        for axis, (plot, slider) in enumerate(zip(self._plots, self._sliders, strict=True)):
            plot.data = (seconds, self._plotted[:, axis], self._plotted[:, axis + len(COMPONENTS)])
            slider.value = round(float(target[axis]), 1)


def _place_camera(client: viser.ClientHandle) -> None:
    """Look at the robot, which the scene keeps at its origin."""
    client.camera.up_direction = (0.0, 0.0, 1.0)
    client.camera.position, client.camera.look_at = CAMERA_M, (0.0, 0.0, -0.3)


def check_port(host: str, port: int) -> None:
    """Raise ValueError unless we can listen there: viser would take the next free port without a word."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            sentence = f"port={port} at host={host} cannot be used ({error.strerror}); choose another port."
            raise ValueError(sentence) from error
