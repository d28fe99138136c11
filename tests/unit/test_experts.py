"""A rebuilt expert replaces a saved one only where it is better, in the demonstrator's own environment."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from oodil.pipeline.artifacts import RunDirectory, encode_json, write_artifact
from oodil.pipeline.config import RunConfig
from oodil.pipeline.errors import ExpertError
from oodil.pipeline.loading import load_config
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.results import Evaluation
from oodil.pipeline.stage import Run
from oodil.pipeline.stages.experts import ExpertsStage, expert_files, load_expert
from tests.runs import MICRO, ROOT

SHIPPED = ROOT / "configs" / "experts" / "hopper-gravity-9.8"
OWN = {"gravity": 9.8}


@pytest.fixture
def good() -> GaussianPolicy:
    """The shipped expert, which returns thousands in gravity 9.8."""
    return load_expert(SHIPPED)[0]


@pytest.fixture
def poor(good: GaussianPolicy) -> GaussianPolicy:
    """One that does nothing, and falls."""
    nothing = tuple(np.zeros_like(weight) for weight in good.weights)
    return replace(good, weights=nothing, biases=tuple(np.zeros_like(bias) for bias in good.biases))


@pytest.fixture
def rebuilt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[GaussianPolicy], tuple[list[str], RunConfig]]:
    """Return a function that exports a policy as if it had just been trained for the source in gravity 9.8."""
    monkeypatch.setattr("oodil.pipeline.stages.experts.EVALUATION_EPISODES", 4)
    values = load_config(MICRO).model_dump(mode="json")
    values["demonstrations"]["sources"][0]["expert"] = str(tmp_path / "expert")
    values["demonstrations"]["sources"] = values["demonstrations"]["sources"][:1]
    config = load_config(values)

    def export(policy: GaussianPolicy) -> tuple[list[str], RunConfig]:
        run = Run(config, RunDirectory(tmp_path / "run"))
        stage = ExpertsStage()
        write_artifact(run.directory.job("experts", "source-0-seed-0"), {}, files(policy))
        write_artifact(run.directory.stage("experts"), {}, {"chosen.json": encode_json({"0": "source-0-seed-0"})})
        return stage.export(run), config

    return export


def files(policy: GaussianPolicy, env_id: str = "oodil/Hopper-v0", seed: int = 0) -> dict[str, bytes]:
    return expert_files(policy, {"environment": {"id": env_id, "dynamics": OWN}, "seed": seed})


def test_the_first_expert_is_saved(tmp_path, rebuilt, poor, assert_same_bits):
    (line,), _ = rebuilt(poor)
    assert line.endswith(f"-> {tmp_path / 'expert'}") and "in place" not in line
    assert_same_bits(load_expert(tmp_path / "expert")[0], poor)


def test_a_worse_one_does_not_replace_the_saved_one(tmp_path, rebuilt, good, poor):
    saved = write_artifact(tmp_path / "expert", {"expert": OWN}, files(good, seed=5))
    (line,), _ = rebuilt(poor)
    assert f"not saved; kept the expert in {tmp_path / 'expert'}: return" in line
    assert load_expert(tmp_path / "expert")[1] == saved


def test_a_better_one_does(tmp_path, rebuilt, good, poor, assert_same_bits):
    write_artifact(tmp_path / "expert", {"expert": OWN}, files(poor, seed=5))
    (line,), _ = rebuilt(good)
    assert "in place of one: return" in line
    policy, artifact = load_expert(tmp_path / "expert")
    assert_same_bits(policy, good)
    assert artifact.json("expert.json")["seed"] == 0


def test_one_that_is_as_good_does_not(tmp_path, rebuilt, good):
    saved = write_artifact(tmp_path / "expert", {"expert": OWN}, files(good, seed=5))
    (line,), _ = rebuilt(good)
    assert "not saved; kept" in line
    assert load_expert(tmp_path / "expert")[1] == saved


def test_one_whose_return_is_not_a_number_does_not(tmp_path, rebuilt, good, poor, monkeypatch):
    saved = write_artifact(tmp_path / "expert", {"expert": OWN}, files(poor, seed=5))
    unknown = Evaluation(np.full(4, np.nan), np.full(4, 1000))
    monkeypatch.setattr("oodil.pipeline.stages.experts.evaluate", lambda *_, **__: unknown)
    (line,), _ = rebuilt(good)
    assert "not saved; kept" in line
    assert load_expert(tmp_path / "expert")[1] == saved


def test_a_damaged_one_is_replaced(tmp_path, rebuilt, good, poor, assert_same_bits):
    write_artifact(tmp_path / "expert", {"expert": OWN}, files(good))
    (tmp_path / "expert" / "policy.safetensors").write_bytes(b"broken")
    rebuilt(poor)
    assert_same_bits(load_expert(tmp_path / "expert")[0], poor)


def test_the_expert_of_another_environment_is_not_touched(tmp_path, rebuilt, good):
    _, config = rebuilt(good)
    ExpertsStage().check(config)
    write_artifact(tmp_path / "expert", {"expert": OWN}, files(good, "oodil/Walker2d-v0"))
    with pytest.raises(ExpertError, match=r"holds an expert of oodil/Walker2d-v0, not of oodil/Hopper-v0"):
        ExpertsStage().check(config)


def test_a_shipped_expert_that_took_more_seeds_is_the_better_one():
    """The back leg's at 0.9 is of seed 5; seeds 0 and 1, which a rebuild trains, return 2,361 at most."""
    _, artifact = load_expert(ROOT / "configs" / "experts" / "half-cheetah-back-0.9")
    described = artifact.json("expert.json")
    assert described["seed"] == 5 and described["stochastic"]["return_mean"] > 4000
