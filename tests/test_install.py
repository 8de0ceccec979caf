"""The wheel, installed where no checkout is near."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder into which the wheel alone is installed."""
    dist, site = tmp_path_factory.mktemp("dist"), tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", dist, ROOT], check=True)
    (wheel,) = dist.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", site, wheel], check=True)
    return site


def run_installed(site, folder, program):
    code = f"import sys; sys.path.insert(0, {str(site)!r})\n{program}"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def test_the_wheel_finds_its_robot(installed, tmp_path):
    program = (
        "import cassie_mjx.robot.model as m; print(m.__file__, m.load_model(m.ModelConfig()).nq, m.xml_path('terrain'))"
    )
    module, nq, xml = run_installed(installed, tmp_path, program).split()
    assert module.startswith(str(installed))
    assert nq == "35"
    assert xml.startswith(str(installed))


def test_the_wheel_has_the_console_script_and_its_types(installed, tmp_path):
    assert (installed / "cassie_mjx" / "py.typed").is_file()
    program = "import runpy, sys; sys.argv = ['cassie-mjx']; runpy.run_path({!r}, run_name='__main__')"
    script = program.format(str(installed / "bin" / "cassie-mjx"))
    assert run_installed(installed, tmp_path, script).startswith("  report")


def test_the_wheel_finds_its_policy(installed, tmp_path):
    program = "from cassie_mjx.agents import make as e; print(e.__file__, e.make_agent('1x').provenance['seed'])"
    module, seed = run_installed(installed, tmp_path, program).split()
    assert module.startswith(str(installed))
    assert int(seed) >= 0
