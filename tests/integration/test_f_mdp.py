"""The competing method f-MDP in a whole run: the same bits however it runs, and it appears wherever methods do."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import oodil
from oodil.pipeline.errors import DataError, UnfinishedError
from oodil.pipeline.results import FeasibilityScale, Tracker
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import Run
from oodil.pipeline.stages.weighting import CannotScoreError
from tests.runs import MICRO, artifacts, has_checkpoint

pytestmark = pytest.mark.timeout(300)
LONGER = ["transferability.gail.total_steps=6_000", "transferability.gail.steps_per_rollout=50"]
"""An iteration of f-MDP is a whole episode of 1000 steps, and six of them have to be there to be stopped in."""
OVERRIDES = ["baselines=[f_mdp, f_mdp_per_source]", "f_mdp.steps_per_iteration=400", *LONGER]
WEIGHTINGS = ("feasibility", "feasibility_per_source")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> RunResults:
    """A finished run, each job in a process of its own."""
    return oodil.run(MICRO, OVERRIDES, workers=2, run_dir=tmp_path_factory.mktemp("f-mdp") / "run")


def test_a_run_that_was_stopped_in_each_training_gives_the_same_bits(results: RunResults, tmp_path: Path) -> None:
    path = tmp_path / "run"
    for stage, job, iteration in (("feasibility", "shared", 3), ("feasibility_per_source", "source-1", 2)):
        with pytest.raises(UnfinishedError):
            stop = has_checkpoint(path, stage, job, iteration)
            oodil.run(MICRO, OVERRIDES, workers=0, run_dir=path, should_stop=stop)
        stopped = oodil.open_run(path).run
        assert not stopped.directory.job(stage, job).exists()
    oodil.run(MICRO, OVERRIDES, workers=0, run_dir=path)
    assert artifacts(path) == artifacts(results.run.directory.path)


def test_what_is_left_behind(results: RunResults) -> None:
    run, demonstrations = results.run, results.demonstrations
    for name in WEIGHTINGS:
        found, scale = results.weighting(name), FeasibilityScale.load(run.artifact(name))
        jobs = ["shared"] if name == "feasibility" else ["source-0", "source-1"]
        trackers = [Tracker.load(run.job_artifact(name, job)) for job in jobs]
        members = np.concatenate([tracker.demonstrations for tracker in trackers])
        assert members.tolist() == list(range(7))
        distances = np.concatenate([tracker.distances for tracker in trackers])
        assert scale.nearest == distances.min() > 0
        middle = np.sort(distances)  # a tenth of seven is none
        assert scale.alpha == pytest.approx((middle.mean() - middle[0]) / 10)
        np.testing.assert_allclose(found.scores, np.exp(-np.minimum((distances - scale.nearest) / scale.alpha, 50)))
        np.testing.assert_allclose(found.weights, found.scores / found.scores.sum())
        assert (found.verdicts == "kept").all() and (found.clusters == -1).all()
        # Our two clusters' imitators take 12,000 steps; then each demonstration is tracked once.
        assert found.env_steps == 12_000 + (demonstrations.lengths - 1).sum()
    assert results.weighting(WEIGHTINGS[0]).scores.tolist() != results.weighting(WEIGHTINGS[1]).scores.tolist()


def test_one_policy_for_all_scores_other_demonstrations(results: RunResults, demonstrations: Any) -> None:
    with threadpool_limits(1):
        again = results.score(results.demonstrations, "feasibility")
    held = results.weighting("feasibility")
    np.testing.assert_array_equal(again.scores, held.scores)
    one = results.score(results.demonstrations.select(np.array([4])), "feasibility")
    np.testing.assert_allclose(one.scores, held.scores[4:5], rtol=1e-4)
    assert one.weights.tolist() == [1.0]
    with pytest.raises(DataError, match=r"demonstrations: states have 3 dimensions; those of .*run have 12$"):
        results.score(demonstrations(4), "feasibility")
    with pytest.raises(CannotScoreError, match="a policy for each source of its run and none for new ones"):
        results.score(results.demonstrations, "feasibility_per_source")


def test_it_appears_in_summary_and_report(results: RunResults) -> None:
    summary = results.summary()
    assert {"imitation", "f_mdp", "f_mdp_per_source"} == summary["policies"].keys()
    assert set(WEIGHTINGS) < summary["weightings"].keys()
    page = Path(oodil.write_report(results)).read_text()
    assert "f-MDP, one policy per source" in page


def test_what_it_depends_on_and_what_it_does_not(results: RunResults) -> None:
    def state(*overrides: str) -> tuple[str, str]:
        changed = Run(oodil.load_config(MICRO, [*OVERRIDES, *overrides]), results.run.directory)
        found = RunResults(changed).states["feasibility"]
        return found.state, found.reason

    gail = "transferability.gail"
    unused = (f"{gail}.discriminator.hidden=[8]", f"{gail}.lag=0", f"{gail}.num_groups=4")
    assert state("clustering.temperature=0.5", *unused)[0] == "done"
    assert state("f_mdp.alpha=5") == ("stale", "f_mdp.alpha None -> 5.0")
    assert state(f"{gail}.total_steps=6500") == ("stale", "steps 12000 -> 13000")
    assert state("clustering.num_clusters=3") == ("stale", "steps 12000 -> 18000")
    assert state(f"{gail}.gae_lambda=0.5") == ("stale", "learning.gae_lambda 0.97 -> 0.5")
