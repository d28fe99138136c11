"""A whole run by the paper's constants, on clusters without an encoder; other demonstrations are scored by it, too."""

import numpy as np
import pytest

import oodil
from oodil.pipeline.algorithms.discriminator import mean_logit_per_demonstration
from oodil.pipeline.artifacts import RunDirectory
from oodil.pipeline.results import Imitator
from oodil.pipeline.stage import Run
from oodil.pipeline.stages.imitators import ClusterJob
from tests.runs import MICRO

pytestmark = pytest.mark.timeout(300)
OVERRIDES = ["preset=paper", "clustering.features=states", "evaluation.num_points=0"]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> oodil.RunResults:
    """A finished run."""
    return oodil.run(MICRO, OVERRIDES, workers=0, run_dir=tmp_path_factory.mktemp("paper") / "run")


def test_scores_are_those_of_the_last_discriminator_and_weights_in_proportion(results: oodil.RunResults) -> None:
    run, found = results.run, results.transferability
    assert found.read_from == {k: f"cluster-{k}" for k in np.unique(found.clusters)}
    for cluster, job in found.read_from.items():
        trained = ClusterJob.of(run, job)
        discriminator = trained.learner(run.config).reward_model.discriminator
        arrays = Imitator.load(run.job_artifact("imitators", job)).discriminator
        for name, value in discriminator.state_dict().items():
            value.copy_(value.new_tensor(arrays[name]))
        logits = mean_logit_per_demonstration(discriminator, trained.demonstrations)
        expected = np.minimum(1, 2 / (1 + np.exp(logits)))
        np.testing.assert_allclose(found.scores[found.clusters == cluster], expected, rtol=1e-6)
        np.testing.assert_array_equal(found.history[cluster].logits[-1], logits)
    np.testing.assert_allclose(found.weights, found.scores / found.scores.sum())
    np.testing.assert_array_equal(found.intervals, np.stack((found.scores, found.scores), axis=1))
    assert found.env_steps == 0 and set(found.verdicts) == {"kept"}


def test_demonstrations_are_scored_by_the_frozen_models(results: oodil.RunResults) -> None:
    again = results.score(results.demonstrations)
    known = ~np.isnan(again.scores)
    assert known.any()
    np.testing.assert_array_equal(again.clusters, results.transferability.clusters)
    np.testing.assert_array_equal(again.scores[known], results.transferability.scores[known])
    assert again.weights.sum() == pytest.approx(1) and not again.weights[~known].any()


def test_what_fresh_discriminators_would_do_computes_nothing_again(results: oodil.RunResults) -> None:
    def states(override: str) -> dict[str, str]:
        config = oodil.load_config(MICRO, [*OVERRIDES, override])
        changed = oodil.RunResults(Run(config, RunDirectory(results.path)))
        return {name: state.reason for name, state in changed.states.items() if state.state == "stale"}

    assert not states("transferability.reading.steps=11")
    fresh = states("transferability.reading.discriminator=fresh")
    assert fresh["transferability"] == "discriminator 'last' -> 'fresh'" and "imitators" not in fresh
    assert states("clustering.features=contrastive")["clustering"] == "features 'states' -> 'contrastive'"
    assert states("preset=official").keys() >= {"clustering", "imitation"}


def test_the_report_says_the_rule(results: oodil.RunResults) -> None:
    page = " ".join(oodil.write_report(results).read_text().split())
    assert "The rule of weights: a demonstration is drawn for imitation in proportion to its score." in page


def test_a_threshold_drops_what_the_last_discriminator_tells_from_the_imitator(results: oodil.RunResults) -> None:
    share = 0.9
    config = oodil.load_config(MICRO, [*OVERRIDES, f"transferability.kept_from={share}"])
    changed = oodil.run(config, workers=0, run_dir=results.path, force=["transferability"])
    found = changed.transferability
    clusters = [found.scores[found.clusters == k] for k in np.unique(found.clusters)]
    best = max(scores[scores >= share * scores.max()].mean() for scores in clusters)
    np.testing.assert_array_equal(found.weights > 0, found.scores >= share * best)
    assert 0 < (found.weights > 0).sum() < len(found.weights)
