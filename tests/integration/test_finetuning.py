"""``oodil finetune``: a run's policy goes on with later demonstrations, with the same bits whatever happens."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import oodil
from oodil.cli import app
from oodil.pipeline.algorithms.weights import kept_weights
from oodil.pipeline.artifacts import write_file
from oodil.pipeline.datasets import encode_demonstrations
from oodil.pipeline.results import load_value
from tests.runs import MICRO, LiveRun, artifacts, has_checkpoint, run, wait_for

pytestmark = pytest.mark.timeout(300)
SMALL = ("finetuning.total_steps=1800",)  # 12 iterations


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> oodil.RunResults:
    """A finished run, with a weighting that can score others (distance) and one that cannot (marks)."""
    path = tmp_path_factory.mktemp("base") / "run"
    return oodil.run(MICRO, ["baselines=['tests.toy:far', oracle]"], workers=0, run_dir=path)


@pytest.fixture(scope="module")
def file(base: oodil.RunResults) -> Path:
    """Three demonstrations that come later: of the run's own, so that something is known of them."""
    path = base.path.parent / "later.safetensors"
    chosen = base.demonstrations.select(np.array([1, 4, 5]))
    write_file(path, encode_demonstrations(chosen, "oodil/Hopper-v0"))
    return path


@pytest.fixture(scope="module")
def tuned(base: oodil.RunResults, file: Path) -> oodil.RunResults:
    """A fine-tuning that nothing disturbed, made in this process."""
    return oodil.finetune(base, file, SMALL, workers=0)


def test_it_learns_from_old_and_new_demonstrations_by_frozen_scores(
    base: oodil.RunResults, file: Path, tuned: oodil.RunResults
) -> None:
    assert tuned.path == base.path.with_name("run-finetuned-later-transferability")
    assert list(tuned.states) == ["demonstrations", "later_scores", "finetuning"]
    assert len(tuned.demonstrations) == 10
    assert tuned.demonstrations.source_labels == ("fast", "slow", "fast", "slow")
    found, known, later = tuned.weighting("later_scores"), base.transferability, oodil.score(base, file)
    np.testing.assert_array_equal(found.scores[:7], known.scores)
    np.testing.assert_array_equal(found.scores[7:], later.found["transferability"].scores)
    np.testing.assert_array_equal(found.weights, kept_weights(found.scores, found.intervals, known.threshold))
    kept = known.weights > 0
    np.testing.assert_allclose(found.weights[:7][kept] / found.weights[:7].sum(), known.weights[kept])
    other = oodil.score(tuned, file).found["later_scores"]
    np.testing.assert_array_equal(other.scores, found.scores[7:])


def test_marks_of_the_run_say_how_well_the_frozen_scores_tell_all_sources_apart(tuned: oodil.RunResults) -> None:
    marks = [True] * 3 + [False] * 4 + [True, False, False]
    found, known = tuned.weighting("later_scores"), tuned.marks()
    assert known is not None and known.tolist() == marks
    steps = tuned.demonstrations.lengths - 1
    mass = found.weights * steps / (found.weights * steps).sum()
    scores = np.nan_to_num(found.scores)
    ranks = [(a > b) + 0.5 * (a == b) for a in scores[known] for b in scores[~known]]
    figures = tuned.summary()["weightings"]["later_scores"]
    assert figures["share_before"] == pytest.approx(steps[known].sum() / steps.sum())
    assert figures["share"] == pytest.approx(mass[known].sum())
    assert figures["auroc"] == pytest.approx(np.mean(ranks))
    shown = CliRunner().invoke(app, ["status", str(tuned.path)]).output
    assert f"AUROC, frozen weighting: {figures['auroc']:.3f}" in shown
    assert f"frozen weighting: {figures['share_before']:.3f} -> {figures['share']:.3f}" in shown


def test_sources_that_the_run_does_not_know_are_marked_in_the_command(
    base: oodil.RunResults, file: Path, tmp_path: Path
) -> None:
    from oodil.api import finetuning

    later = replace(oodil.open_run(base.path).demonstrations, source_labels=("unheard of", "slow"))
    other = tmp_path / "other.safetensors"
    write_file(other, encode_demonstrations(later, "oodil/Hopper-v0"))

    def separation(*overrides: str) -> dict[str, float]:
        config, _ = finetuning(base, other, [*SMALL, *overrides], weighting="distance")
        return oodil.run(config, workers=0, run_dir=tmp_path / "run", until="later_scores").separation("later_scores")

    assert separation()["auroc"] == pytest.approx(base.separation("distance")["auroc"]), "unmarked: left out"
    found = separation("demonstrations.transferable=[unheard of]")
    # Twice the same demonstrations: all that is told of them stays as it was.
    assert found["auroc"] == pytest.approx(base.separation("distance")["auroc"])
    assert found["share"] == pytest.approx(base.separation("distance")["share"])


def test_marks_of_a_file_serve_an_ordinary_run_and_its_oracle(file: Path, tmp_path: Path) -> None:
    overrides = ["demonstrations.sources=[]", f"demonstrations.file={file}", "baselines=[oracle]"]
    marked = [*overrides, "demonstrations.transferable=[fast]"]
    found = oodil.run(MICRO, marked, workers=0, run_dir=tmp_path / "run", until="marks")
    marks = found.marks()
    assert marks is not None and marks.tolist() == [True, False, False]
    assert found.weighting("marks").weights.tolist() == [1.0, 0.0, 0.0]
    assert found.separation("marks")["auroc"] == 1
    with pytest.raises(oodil.OodilError, match="the oracle needs sources that are marked"):
        oodil.load_config(MICRO, overrides)


def test_it_begins_with_the_policy_of_the_run(base: oodil.RunResults, tuned: oodil.RunResults) -> None:
    before, curve = base.curve(), tuned.curve("finetuning")
    assert curve.env_steps.tolist() == [0, 960, 1920]
    assert (curve.mean_return[0], curve.mean_length[0]) == (before.mean_return[-1], before.mean_length[-1])
    assert tuned.policy("finetuning").env_steps == 1920
    assert load_value(base.artifact("imitation")).keys() == load_value(tuned.artifact("finetuning")).keys()
    # Inputs are still those that the networks were trained with; the noise has shrunk again.
    np.testing.assert_array_equal(tuned.policy("finetuning").gaussian.input_mean, base.policy().gaussian.input_mean)
    np.testing.assert_allclose(np.exp(tuned.policy("finetuning").gaussian.log_std), 0.1, rtol=1e-5)


def test_the_noise_is_set_to_what_is_asked_for(base: oodil.RunResults, file: Path) -> None:
    from oodil.api import finetuning
    from oodil.pipeline.algorithms.gail import imitator
    from oodil.pipeline.stage import Run, stage_named
    from oodil.pipeline.stages.finetuning import FinetuningStage

    config, _ = finetuning(base, file, ["finetuning.initial_std=0.2"])
    stage = stage_named("finetuning")
    assert isinstance(stage, FinetuningStage)
    assert stage.gail(config).total_steps == 1200  # a quarter of 4,800
    demonstrations = base.demonstrations
    learner = imitator(12, 3, 1000, demonstrations, np.ones(len(demonstrations)), stage.gail(config), seed=5)
    assert stage.begin(Run(config, base.run.directory), "training-1", learner) == (True, 0)
    policy = learner.behavior_policy()
    np.testing.assert_allclose(np.exp(policy.log_std), 0.2, rtol=1e-6)
    observations = demonstrations.observations[:50].astype(np.float64)
    np.testing.assert_array_equal(policy.mean(observations), base.policy().gaussian.mean(observations))
    value = load_value(base.artifact("imitation"))
    assert all(np.array_equal(each, value[name]) for name, each in learner.value_arrays().items())


@pytest.mark.parametrize("workers", [0, 2])
def test_stopped_and_repeated_it_has_the_same_bits(
    base: oodil.RunResults, file: Path, tuned: oodil.RunResults, tmp_path: Path, workers: int
) -> None:
    undisturbed = artifacts(tuned.path)

    def begun() -> bool:
        return has_checkpoint(tmp_path / "run", "finetuning", "training-1", 4)()

    with pytest.raises(oodil.UnfinishedError, match="oodil resume"):
        oodil.finetune(base, file, SMALL, workers=workers, run_dir=tmp_path / "run", should_stop=begun)
    oodil.finetune(base, file, SMALL, workers=2 - workers, run_dir=tmp_path / "run")
    assert artifacts(tmp_path / "run") == undisturbed


def test_killed_and_resumed_it_has_the_same_bits(
    base: oodil.RunResults, file: Path, tuned: oodil.RunResults, tmp_path: Path
) -> None:
    live = LiveRun("finetune", str(base.path), str(file), *SMALL, "--workers", "2", "--run-dir", str(tmp_path / "run"))
    wait_for(has_checkpoint(tmp_path / "run", "finetuning", "training-1", 5), "checkpoint")
    live.kill_group()
    assert "resumed from checkpoint" in run("resume", str(tmp_path / "run"), "--workers", "0")
    assert artifacts(tmp_path / "run") == artifacts(tuned.path)
    again = run("finetune", str(base.path), str(file), *SMALL, "--run-dir", str(tmp_path / "run"))
    assert "finetuning: reused" in again and "final return, fine-tuned" in again


def test_the_other_verbs_work_on_it(tuned: oodil.RunResults) -> None:
    for command in (["status"], ["evaluate", "--episodes", "2"], ["report"]):
        result = CliRunner().invoke(app, [command[0], str(tuned.path), *command[1:]])
        assert result.exit_code == 0, (result.output, result.exception)
    assert "fine-tuned" in (tuned.path / "report.html").read_text()


def test_another_weighting_has_a_folder_of_its_own(base: oodil.RunResults, file: Path) -> None:
    found = oodil.finetune(base, file, ["finetuning.total_steps=1"], weighting="distance", workers=0)
    assert found.path.name == "run-finetuned-later-distance"
    known, scores = base.weighting("distance").scores, found.weighting("later_scores")
    np.testing.assert_allclose(scores.scores, known[[*range(7), 1, 4, 5]])
    np.testing.assert_allclose(scores.weights, scores.scores / scores.scores.sum())


def test_bad_input_starts_nothing(base: oodil.RunResults, file: Path, tuned: oodil.RunResults, tmp_path: Path) -> None:
    def refused(*arguments: object) -> str:
        result = CliRunner().invoke(app, ["finetune", *map(str, arguments), "--run-dir", str(tmp_path / "new")])
        assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
        assert len(result.output.strip().splitlines()) == 1 and not (tmp_path / "new").exists()
        return result.output

    assert "marks say nothing" in refused(base.path, file, "--weighting", "marks")
    assert "no weighting 'far'" in refused(base.path, file, "--weighting", "far")
    assert "`oodil demos convert` makes one" in refused(base.path, tmp_path / "states.npz")
    assert "No such file" in refused(base.path, tmp_path / "none.safetensors")
    other = tmp_path / "walker.safetensors"
    write_file(other, encode_demonstrations(base.demonstrations, "oodil/Walker2d-v0"))
    assert "recorded in oodil/Walker2d-v0" in refused(base.path, other)
    assert f"{file}: has no source 'quick', only fast, slow" in refused(
        base.path, file, "demonstrations.transferable=[quick]"
    )
    assert "initial_std is 0.05; it must reach" in refused(base.path, file, "finetuning.initial_std=0.05")
    assert "policy_hidden is [8]; the policy that is continued has [64, 64]" in refused(
        base.path, file, "imitation.gail.policy_hidden=[8]"
    )
    shutil.copytree(base.path, tmp_path / "begun")
    shutil.rmtree(tmp_path / "begun" / "stages" / "imitation")
    assert "imitation is partial" in refused(tmp_path / "begun", file)


def test_another_file_of_the_same_name_is_refused(
    base: oodil.RunResults, file: Path, tuned: oodil.RunResults, tmp_path: Path
) -> None:
    write_file(tmp_path / file.name, encode_demonstrations(base.demonstrations, "oodil/Hopper-v0"))
    result = CliRunner().invoke(app, ["finetune", str(base.path), str(tmp_path / file.name), *SMALL])
    assert result.exit_code == 2 and "demonstrations is finished with other settings (file_sha256" in result.output
