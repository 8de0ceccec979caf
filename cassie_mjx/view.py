"""A walk to steer and to push about: `python -m cassie_mjx.view policy=any` opens MuJoCo's interactive viewer.

With `web=true` it serves the same in a browser.
"""

import sys
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated

import mujoco
import mujoco.viewer

from cassie_mjx import cli
from cassie_mjx.agents.make import AgentConfig
from cassie_mjx.agents.shipped import shipped_policies
from cassie_mjx.configuration.values import Range
from cassie_mjx.evaluation.viewer import Live, check_screen, keep_showing, steerable
from cassie_mjx.heuristic.config import CONTROLLERS
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import Terrain, parse_terrain


@dataclass(frozen=True)
class ViewConfig(AgentConfig):
    """What to watch."""

    terrain: str = "0"
    """What is walked on: height h of hills z = h sin x, m, or a kind and its level, slope:0.2 or across:0.2 (rad),
    steps:0.1 or rough:0.1 (m)."""
    web: bool = False
    """Whether to serve a page for browsers in place of a window."""
    host: str = "127.0.0.1"
    """Address that the page is served at: this computer alone, or 0.0.0.0 for all that reach it."""
    port: Annotated[int, Range(1, 65535)] = 8080
    """Port that the page is served at."""

    def __post_init__(self) -> None:
        """Raise ValueError for a terrain that there is not."""
        super().__post_init__()
        parse_terrain(self.terrain)


def main(config: ViewConfig) -> None:
    """Open the viewer, and walk until its window is closed or Ctrl-C is typed."""
    if config.web:
        _serve(config)
        return
    if sys.platform != "darwin":
        check_screen()
    live = Live(steerable(config.agent()), parse_terrain(config.terrain))
    try:
        window = mujoco.viewer.launch_passive(
            live.model, live.data, key_callback=live.keys.append, show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:
        raise ValueError(f"The viewer does not start: {error}; on macOS use mjpython in place of python.") from error
    with window as viewer, suppress(KeyboardInterrupt):
        with viewer.lock():
            viewer.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
            viewer.cam.trackbodyid = viewer.perturb.select = cassie.PELVIS_BODY
            viewer.cam.distance, viewer.cam.azimuth, viewer.cam.elevation = 3.0, 135.0, -15.0
            viewer.opt.flags[mujoco.mjtVisFlag.mjVIS_PERTFORCE] = True
        keep_showing(viewer, live)


def _serve(config: ViewConfig) -> None:
    """Walk in browsers until Ctrl-C is typed."""
    try:
        from cassie_mjx.evaluation.web import WebView
    except ImportError as error:
        raise ValueError(
            f"web=true needs viser and mjviser ({error}); install them with pip install 'cassie-mjx[web]'."
        ) from error

    def make(policy: str, terrain: Terrain) -> Live:
        chosen = config if policy == config.policy else AgentConfig(policy=policy)
        return Live(steerable(chosen.agent()), terrain)

    others = [*shipped_policies(), *(f"controller:{name}" for name in CONTROLLERS)]
    policies = list(dict.fromkeys([config.policy, *others]))
    view = WebView(make, policies, parse_terrain(config.terrain), config.host, config.port)
    print(f"Open http://{config.host}:{config.port} in a browser; Ctrl-C ends it.", flush=True)
    with suppress(KeyboardInterrupt):
        view.run()
    view.close()


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, ViewConfig)


if __name__ == "__main__":
    run()
