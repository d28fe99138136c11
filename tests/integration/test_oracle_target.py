"""The oracle of the imitator's own dynamics: its demonstrations lie beside those of the mixture, never among them."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import oodil
from oodil.cli import app
from oodil.pipeline.artifacts import read_artifact
from oodil.pipeline.environments import make_batch
from oodil.pipeline.results import CollectedDemonstrations
from oodil.pipeline.stage import Run
from oodil.pipeline.stages.experts import load_expert
from tests.runs import MICRO, ROOT, artifacts, has_checkpoint, without_baselines

pytestmark = pytest.mark.timeout(300)
EXPERTS = ROOT / "configs" / "experts"
OVERRIDES = ("baselines=[oracle_target]", f"oracle_target={{expert: {EXPERTS}/hopper-gravity-12.0, count: 2}}")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> oodil.RunResults:
    """A finished run that nothing disturbed, made in this process."""
    return oodil.run(MICRO, OVERRIDES, workers=0, run_dir=tmp_path_factory.mktemp("target") / "run")


def collected(results: oodil.RunResults) -> CollectedDemonstrations:
    return CollectedDemonstrations.load(results.artifact("target_demonstrations"))


def test_nothing_but_the_oracle_sees_its_demonstrations(results: oodil.RunResults, undisturbed: dict[str, str]) -> None:
    own = {"target_demonstrations", "oracle_target"}
    hashes = artifacts(results.path)
    assert own < hashes.keys()
    assert {name: sha256 for name, sha256 in hashes.items() if name not in own} == without_baselines(undisturbed)
    assert len(results.demonstrations) == 7 and len(collected(results).demonstrations) == 2
    assert set(results.summary()["policies"]) == {"imitation", "oracle_target"}
    # It learns from them: inputs are standardized over what is demonstrated and met.
    assert not np.array_equal(
        results.policy("oracle_target").gaussian.input_mean, results.policy("imitation").gaussian.input_mean
    )


def test_they_are_whole_episodes_of_the_imitators_own_dynamics(results: oodil.RunResults) -> None:
    found = collected(results)
    assert found.environment_id == "oodil/Hopper-v0" and found.demonstrations.lengths.tolist() == [1001, 1001]
    assert (found.demonstrations.returns > 2500).all()
    policy, _ = load_expert(EXPERTS / "hopper-gravity-12.0")
    own, other = (make_batch("oodil/Hopper-v0", {"gravity": gravity}, 1) for gravity in (12.0, 9.8))
    misses: list[list[float]] = [[], []]
    # Noise of the actions errs to both sides, another gravity to one: seen in the root's vertical velocity.
    for n, before in enumerate(found.demonstrations[0][:300].astype(np.float64)):
        for simulators, missed in zip((own, other), misses, strict=True):
            simulators.place(0, before)
            simulators.step(policy.mean(before[None]))
            missed.append(simulators.observations()[0, 7] - found.demonstrations[0][n + 1, 7])
    assert abs(np.median(misses[0])) < 0.005 < 0.01 < np.median(misses[1])


@pytest.mark.parametrize("workers", [0, 2])
def test_stopped_and_repeated_it_has_the_same_bits(results: oodil.RunResults, tmp_path: Path, workers: int) -> None:
    begun = has_checkpoint(tmp_path / "run", "oracle_target", "training-1", 20)
    with pytest.raises(oodil.UnfinishedError, match="oodil resume"):
        oodil.run(MICRO, OVERRIDES, workers=workers, run_dir=tmp_path / "run", should_stop=begun)
    oodil.run(MICRO, OVERRIDES, workers=2 - workers, run_dir=tmp_path / "run")
    assert artifacts(tmp_path / "run") == artifacts(results.path)


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("oracle_target.count=3", "count 2 -> 3"),
        ("demonstrations.deterministic=true", "deterministic False -> True"),
        (f"oracle_target.expert={EXPERTS}/hopper-gravity-9.8", "expert_sha256"),
    ],
)
def test_what_is_computed_again(results: oodil.RunResults, override: str, reason: str) -> None:
    config = oodil.load_config(MICRO, [*OVERRIDES, override])
    states = oodil.RunResults(Run(config, results.run.directory)).states
    assert states["target_demonstrations"].state == "stale" and reason in states["target_demonstrations"].reason
    assert states["oracle_target"].reason == "its input target_demonstrations is stale"


def test_bad_input_starts_nothing(tmp_path: Path) -> None:
    def refused(*overrides: str) -> str:
        arguments = ["run", str(MICRO), "baselines=[oracle_target]", *overrides, "--run-dir", str(tmp_path / "run")]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
        assert len(result.output.strip().splitlines()) == 1 and not (tmp_path / "run").exists()
        return result.output

    assert "oracle_target learns from an expert of the imitator's own dynamics; name one" in refused()
    assert "oracle_target.count: required" in refused("oracle_target={expert: hand-written}")
    assert "no expert is saved here" in refused(f"oracle_target={{expert: {tmp_path}/none, count: 1}}")
    assert "brings no hand-written controller" in refused("oracle_target={expert: hand-written, count: 1}")
    wrong = f"oracle_target={{expert: {EXPERTS}/hopper-gravity-9.8, count: 1}}"
    assert "was trained with gravity 9.8; the imitator has gravity 12" in refused(wrong)
    other = f"oracle_target={{expert: {EXPERTS}/walker2d-friction-24.8, count: 1}}"
    assert "the expert sees 18 dimensions; environment oodil/Hopper-v0 has 12" in refused(other)


def test_finished_demonstrations_need_their_expert_no_more(results: oodil.RunResults, tmp_path: Path) -> None:
    expert, path = tmp_path / "expert", tmp_path / "run"
    shutil.copytree(EXPERTS / "hopper-gravity-12.0", expert)
    overrides = [OVERRIDES[0], f"oracle_target={{expert: {expert}, count: 2}}"]
    oodil.run(MICRO, overrides, workers=0, until="target_demonstrations", run_dir=path)
    shutil.rmtree(expert)
    result = CliRunner().invoke(app, ["resume", str(path), "--workers", "0"])
    assert result.exit_code == 0, result.output
    assert artifacts(path) == artifacts(results.path)


def test_an_expert_that_is_not_asked_for_is_not_looked_at(tmp_path: Path) -> None:
    overrides = [f"oracle_target={{expert: {tmp_path}/none, count: 1}}"]
    path = tmp_path / "run"
    oodil.run(MICRO, overrides, workers=0, until="demonstrations", run_dir=path)
    assert read_artifact(path / "stages" / "demonstrations") is not None
