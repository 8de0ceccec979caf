"""A walk to steer and to push about: `python -m cassie_mjx.view policy=any` opens MuJoCo's interactive viewer."""

import sys
from contextlib import suppress
from dataclasses import dataclass

import mujoco
import mujoco.viewer

from cassie_mjx import cli
from cassie_mjx.agents.make import AgentConfig
from cassie_mjx.evaluation.viewer import Live, check_screen, keep_showing, steerable
from cassie_mjx.robot import cassie
from cassie_mjx.robot.ground import parse_terrain


@dataclass(frozen=True)
class ViewConfig(AgentConfig):
    """What to watch."""

    terrain: str = "0"
    """What is walked on: height h of hills z = h sin x, m, or a kind and its level, slope:0.2 or across:0.2 (rad),
    steps:0.1 or rough:0.1 (m)."""

    def __post_init__(self) -> None:
        """Raise ValueError for a terrain that there is not."""
        super().__post_init__()
        parse_terrain(self.terrain)


def main(config: ViewConfig) -> None:
    """Open the viewer, and walk until its window is closed or Ctrl-C is typed."""
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


def run() -> None:
    """Read the command line, and do it."""
    cli.run(main, ViewConfig)


if __name__ == "__main__":
    run()
