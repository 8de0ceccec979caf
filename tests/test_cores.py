"""What more cores bring: the model by hand, and a measurement of seconds."""

import json

import pytest
import tiny

from cassie_mjx.physics import native
from cassie_mjx.training import devices
from experiments import cores
from experiments.cores import CoresConfig, computed, main, row, trained


def test_the_rest_stays_and_robots_share_the_cores():
    train = trained(CoresConfig(measure=(1,), train=("ppo.num_robots=100", "ppo.num_steps=10")))
    # 100 robots take 4 s on one core, and 50 of them 2 s.
    measured = row(train, 2, 2.0, 0.5, "measured")
    found = {count: computed(train, measured, count) for count in (1, 2, 8, 64, 200)}
    assert [each["physics_s"] for each in found.values()] == [4.0, 2.0, 13 * 0.04, 2 * 0.04, 0.04]
    assert {each["rest_s"] for each in found.values()} == {0.5}
    assert found[8]["samples_per_s"] == round(1000 / (13 * 0.04 + 0.5))
    assert found[8]["origin"] == "computed"


def test_bad_input_is_one_sentence(monkeypatch, tmp_path):
    with pytest.raises(ValueError, match="measure is empty"):
        CoresConfig(measure=())
    with pytest.raises(ValueError, match="Did you mean"):
        CoresConfig(train=("ppo.gama=1",))
    monkeypatch.setattr(cores, "cores", lambda: 2)
    with pytest.raises(ValueError, match="measure=1,3 is more than the 2 cores that can be used here."):
        main(CoresConfig(measure=(1, 3), out=str(tmp_path / "out.json")))


@pytest.mark.parametrize(("count", "flags"), [(2, "--xla_cpu_multi_thread_eigen=false"), (4, None), (5, "")])
def test_on_few_cores_the_learner_computes_on_one(monkeypatch, count, flags):
    monkeypatch.setattr(native.os, "sched_getaffinity", lambda process: set(range(count)))
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.delenv("XLA_FLAGS")
    if flags is None:
        # What the user has set stays.
        flags = "--xla_cpu_multi_thread_eigen=true"
        monkeypatch.setenv("XLA_FLAGS", flags)
    devices.share_cores()
    assert devices.os.environ.get("XLA_FLAGS", "") == flags
    assert native.cores() == count


@pytest.mark.slow
def test_cores_are_measured_and_computed(tmp_path):
    small = tuple(each for each in tiny.ARGUMENTS if each.startswith("ppo"))
    main(CoresConfig(measure=(1,), compute=(2,), iterations=2, train=small, out=str(tmp_path / "out.json")))
    measured, more = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert (measured["cores"], measured["origin"]) == (1, "measured")
    assert measured["physics_s"] > 0 < measured["rest_s"]
    assert more["physics_s"] == pytest.approx(measured["physics_s"] / 2, abs=1e-4)
