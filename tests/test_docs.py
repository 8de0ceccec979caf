"""README and docs: every command parses, every script compiles, and (slow) all of them run in order, made small."""

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cassie_mjx import cli
from cassie_mjx.agents.shipped import shipped_policies
from tests import tiny

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
FIRST = [DOCS / f"{name}.md" for name in ("first_run", "train", "evaluate", "deploy", "learners")]
PAGES = [ROOT / "README.md", *FIRST, *sorted(set(DOCS.rglob("*.md")) - set(FIRST))]
"""In the order in which a reader follows them."""
BLOCK = re.compile(r'^```(\w+)(?: title="[^"\n]*")?\n(.*?)^```$', re.M | re.S)
# Several hosts, another launcher, a screen; what docs/extending.md adds has a test of its own.
ELSEWHERE = ("srun", "sbatch", "for ", "hydra/launcher", "cassie_mjx.view", "mujoco.viewer", "#SBATCH", "[ $?")
SMALL = {
    # A policy to start from has the default network.
    "cassie_mjx.train": [word for word in tiny.ARGUMENTS if "hidden_sizes" not in word],
    "cassie_mjx.render": ["seconds=0.2", "push_at=0", "width=64", "height=48"],
}
# Measurements of minutes to hours; each has a test of its own.
LONG = tuple(
    f"experiments.{path.stem}" for path in (ROOT / "experiments").glob("*.py") if path.stem != "record_reference"
)
LONG += ("suite=all", "suite=map", "suite=push", "suite=terrain")


def blocks(page, kind):
    return [text for language, text in BLOCK.findall(page.read_text()) if language == kind]


def commands(page):
    """Arguments of each `python -m` command that can be run here: module first."""
    for text in blocks(page, "sh"):
        for line in text.replace("\\\n", " ").splitlines():
            if "python -m" in line and not any(word in line for word in ELSEWHERE):
                yield shlex.split(line.partition("python -m ")[2], comments=True)


def name(page):
    return page.relative_to(ROOT).as_posix()


ALL = [(page, words) for page in PAGES if page.name != "extending.md" for words in commands(page)]


@pytest.mark.parametrize(("page", "words"), [each for each in ALL if each[1][0].startswith(("cassie", "exp"))])
def test_a_command_parses(monkeypatch, tmp_path, page, words):
    module, *arguments = words
    parsed = []
    # The run that the pages begin with.
    best = tmp_path / "runs" / "1x-seed0" / "best.npz"
    best.parent.mkdir(parents=True)
    best.touch()
    monkeypatch.chdir(tmp_path)

    def parse(main, config, *more):
        plain = [word for word in arguments if word not in ("-m", "--help")]
        sweeping = "-m" in arguments
        parsed.append(cli.parse(config, [w.partition(",")[0] if sweeping else w for w in plain], *more[:2]))

    monkeypatch.setattr(cli, "run", parse)
    monkeypatch.setattr(sys, "argv", [module, *arguments])
    runpy.run_path(str(ROOT / f"{module.replace('.', '/')}.py"), run_name="__main__")
    assert parsed


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_scripts_compile_and_lines_are_short(page):
    for text in blocks(page, "python"):
        compile(text, name(page), "exec")
    longest = max(page.read_text().splitlines(), key=lambda line: 0 if line.startswith(("|", "!")) else len(line))
    assert len(longest) <= 160, longest


def test_the_readme_is_one_screen():
    assert len((ROOT / "README.md").read_text().split()) <= 700


def shorter(words):
    words = [word.replace("results=FOLDER", "results=.") for word in words]
    return [*words, *SMALL.get(words[0], ())]


def small(script):
    return "from tests import tiny\n" + script.replace("TrainConfig(speed", "TrainConfig(ppo=tiny.TINY, speed")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_everything_runs_in_order(tmp_path):
    """As a reader would who goes through the pages with one folder at hand."""
    for folder in ("cassie_mjx", "experiments", "tests", "xml"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    (tmp_path / "docs" / "gallery").mkdir(parents=True)
    cache = {"JAX_COMPILATION_CACHE_DIR": str(ROOT / ".cache" / "jax")}
    environment = {**os.environ, **cache, "PYTHONPATH": str(tmp_path), "WANDB_MODE": "offline"}

    def run(words):
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        return "" if done.returncode == 0 else f"{shlex.join(words)}\n{done.stdout}\n{done.stderr}"

    failed = []
    for page in PAGES:
        if page.name in ("extending.md", "clusters.md"):
            continue
        for words in commands(page):
            first = words == ["cassie_mjx.train"]
            if first:
                shutil.rmtree(tmp_path / "runs" / "1x-seed0", ignore_errors=True)
            if not any(word.startswith(LONG) for word in words):
                failed.append(run([sys.executable, "-m", *shorter(words)]))
            if first:
                # In place of the policy that the whole training would have come to.
                shutil.copy(shipped_policies()["1x"], tmp_path / "runs" / "1x-seed0" / "best.npz")
        failed += [run([sys.executable, "-c", small(text)]) for text in blocks(page, "python")]
    assert not any(failed), "\n".join(filter(None, failed))
