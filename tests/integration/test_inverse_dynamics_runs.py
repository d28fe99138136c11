"""The policies of ID in a run: resumed wherever it stops with the same bits, and scores of later demonstrations."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import oodil
from oodil.pipeline.errors import DataError, UnfinishedError
from oodil.pipeline.results import Following, Reproducibility
from oodil.pipeline.stages import inverse_dynamics, stages
from tests.runs import artifacts

pytestmark = pytest.mark.timeout(300)
DRIVING = {
    "name": "followed",
    "environment": {"id": "oodil/Driving-v0"},
    "demonstrations": {
        "full_length_only": False,
        "minimum_return": -500,
        "sources": [
            {"label": "as fast", "dynamics": {"obstacle_1": 0.5}, "expert": "hand-written", "count": 3},
            {"label": "five times as fast", "dynamics": {"speed": 5.0}, "expert": "hand-written", "count": 3},
        ],
    },
    "clustering": {"num_clusters": 1},
    "transferability": {"gail": {"total_steps": 1}, "reading": {"steps": 2, "repetitions": 1}},
    "inverse_dynamics": {"transitions": 5000, "hidden": 8, "blocks": 1, "passes": 3},
    "imitation": {"num_trainings": 1, "gail": {"total_steps": 1}},
    "baselines": ["id_random", "id_gail", "exact_id"],
    "evaluation": {"num_points": 0, "episodes": 1, "final_episodes": 1, "num_scores": 2},
    "runtime": {"checkpoint_interval_s": 0},
}
WEIGHTINGS = ("inverse_dynamics_random", "inverse_dynamics_gail", "exact_inverse_dynamics")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run that nothing disturbed."""
    path = tmp_path_factory.mktemp("inline") / "run"
    oodil.run(DRIVING, workers=0, run_dir=path)
    return path


def test_what_a_run_has_because_of_them() -> None:
    names = [stage.name for stage in stages(oodil.load_config(DRIVING))]
    assert {"naive_gail", "reproducibility", *WEIGHTINGS} < set(names)
    alone = [stage.name for stage in stages(oodil.load_config(DRIVING, ["baselines=[id_random]"]))]
    assert not {"naive_gail", "reproducibility"} & set(alone)


def test_any_number_of_workers_and_stops_in_the_middle_give_the_same_files(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inverse_dynamics, "SIMULATORS", 2)
    oodil.run(DRIVING, workers=2, run_dir=tmp_path / "parallel")
    assert artifacts(tmp_path / "parallel") == artifacts(run_dir)
    path = tmp_path / "stopped"
    for name in WEIGHTINGS[:2]:
        checkpoints = path / "checkpoints" / name
        for done in (1, 3, 4):  # among the passes, after them, and among what is followed

            def reached(done: int = done, checkpoints: Path = checkpoints) -> bool:
                return any(int(each.name) >= done for each in checkpoints.glob("*/[0-9]*"))

            with pytest.raises(UnfinishedError):
                oodil.run(DRIVING, workers=0, run_dir=path, should_stop=reached)
            assert reached() and not (path / "stages" / name).exists()
            assert not reached(done + 2), "it goes on from where it stopped, part by part"
    oodil.run(DRIVING, workers=0, run_dir=path)
    assert artifacts(path) == artifacts(run_dir)


def test_they_differ_by_their_exploration_and_each_tells_what_it_took(run_dir: Path) -> None:
    results = oodil.open_run(run_dir)
    lengths, steps = results.demonstrations.lengths, results.env_steps()
    followed = int((lengths - 1).sum())
    for name in WEIGHTINGS[:2]:
        found, kept = results.weighting(name), Following.load(results.artifact(name))
        np.testing.assert_array_equal(found.scores, kept.scores(kept.errors))
        assert steps[name] == found.env_steps
        held_out = found.env_steps - followed - 5120  # 5000, in whole rollouts of 2560
        assert 0 < held_out < 5120
    one, other = (Following.load(results.artifact(name)) for name in WEIGHTINGS[:2])
    assert (one.errors != other.errors).all()


def test_exact_scores_fall_from_what_can_be_followed_to_the_farthest(run_dir: Path) -> None:
    """Nobody can drive five times as fast, and everybody can turn as a car of the same speed does."""
    results = oodil.open_run(run_dir)
    residuals = Reproducibility.load(results.artifact("reproducibility"))
    assert residuals.one_step.shape == (6, 8), "the section's defaults"
    errors = np.quantile(residuals.one_step, 0.75, axis=1)
    found = results.weighting("exact_inverse_dynamics")
    expected = np.clip(1 - (errors - 0.05) / (errors.max() - 0.05), 0, 1)
    np.testing.assert_allclose(found.scores, expected, atol=1e-12)
    assert (found.scores[:3] == 1).all() and (found.scores[3:] < 0.5).all()


@pytest.mark.parametrize("name", WEIGHTINGS)
def test_verdicts_say_what_stays_below_the_upper_bound(run_dir: Path, name: str) -> None:
    results = oodil.open_run(run_dir)
    found, kept = results.weighting(name), Following.load(results.artifact(name))
    followed = kept.errors < kept.highest
    assert followed.any() and not followed.all()
    assert found.verdicts.tolist() == ["kept" if each else "not kept" for each in followed]
    np.testing.assert_array_equal(found.weights > 0, followed)
    np.testing.assert_allclose(found.weights, found.scores / found.scores.sum())


@pytest.mark.parametrize("name", WEIGHTINGS)
def test_later_demonstrations_are_scored_without_training(run_dir: Path, name: str) -> None:
    results = oodil.open_run(run_dir)
    demonstrations, held = results.demonstrations, results.weighting(name)
    again = results.score(demonstrations, name)
    np.testing.assert_array_equal(again.scores, held.scores)
    np.testing.assert_array_equal(again.weights, held.weights)
    assert again.env_steps > 0
    few = results.score(demonstrations.select(np.array([0, 5])), name)
    np.testing.assert_allclose(few.scores, held.scores[[0, 5]], atol=0.05)
    with pytest.raises(DataError, match=r"demonstrations: states have 4 dimensions; those of .* have \d+$"):
        results.score(replace(demonstrations, observations=demonstrations.observations[:, :4].copy()), name)
