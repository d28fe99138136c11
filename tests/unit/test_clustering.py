"""Assignment, centers and the whole of Algorithm 1; the stage gives the same bytes however often it is stopped."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from sklearn.cluster import KMeans
from sklearn.metrics import calinski_harabasz_score, silhouette_score
from torch.nn.functional import normalize

from oodil.pipeline.algorithms.clustering import (
    ClusterModel,
    ContrastiveClustering,
    Labeling,
    assign,
    center_loss,
    clearer_centers,
    clusters_of_states,
    linked_centers,
    moved_centers,
)
from oodil.pipeline.artifacts import RunDirectory, write_artifact
from oodil.pipeline.config import ClusteringConfig, RunConfig
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.errors import DataError
from oodil.pipeline.results import Assignment, ClusterDiagnostics
from oodil.pipeline.stage import JobStoppedError, Run
from oodil.pipeline.stages import clustering as stage_module
from oodil.pipeline.stages.clustering import ClusteringStage, contingency, diagnostics, purity

SMALL = {"hidden": 16, "warmup_iterations": 30, "joint_iterations": 40, "batch_size": 16}


def three_dynamics(counts: tuple[int, int, int], seed: int = 0) -> Demonstrations:
    """Ragged demonstrations of oscillators with three frequencies, each with a random phase and noise."""
    rng = np.random.default_rng(seed)
    states = []
    for source, count in enumerate(counts):
        for _ in range(count):
            t = np.arange(rng.integers(60, 120))
            phase = rng.uniform(0, 2 * np.pi)
            angle = phase + (0.05, 0.25, 0.6)[source] * t
            signal = np.stack((np.sin(angle), np.cos(angle)), axis=1)
            states.append((signal + 0.02 * rng.standard_normal(signal.shape)).astype(np.float32))
    return Demonstrations(
        observations=np.concatenate(states),
        offsets=np.cumsum([0, *(len(s) for s in states)]).astype(np.int64),
        sources=np.repeat(np.arange(3, dtype=np.int32), counts),
        source_labels=("slow", "middle", "fast"),
        returns=np.full(sum(counts), np.nan),
        terminated=np.zeros(sum(counts), np.bool_),
    )


def test_the_nearest_center_is_by_distance_also_when_centers_have_unequal_lengths():
    centers = torch.tensor([[1.0, 0.0], [0.2, 0.2], [-3.0, 0.0]])
    features = torch.tensor([[0.9, 0.1], [0.0, 1.0], [-1.0, 0.0]])
    # Squared distances: (.02, .50, 15.2), (2, .68, 10), (4, 1.48, 4).
    assert assign(features, centers).tolist() == [0, 1, 1]
    assert assign(features[None], centers).tolist() == [[0, 1, 1]]


def test_the_center_loss_by_hand():
    features = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    own = torch.tensor([[0.0, 0.0], [0.0, 3.0]])
    # Squared distances 1 and 4, halved and added.
    assert float(center_loss(features, own, "sum")) == pytest.approx(2.5)
    assert float(center_loss(features, own, "mean")) == pytest.approx(1.25)


def test_centers_move_as_in_a_sequential_loop_over_eqn_4():
    rng = np.random.default_rng(0)
    centers, counts = rng.standard_normal((4, 3)), np.array([100, 7, 100, 1])
    features, labels = rng.standard_normal((50, 3)), rng.integers(0, 3, 50)

    moved, new_counts = moved_centers(*(torch.from_numpy(a) for a in (centers, counts, features, labels)))

    expected, expected_counts = centers.copy(), counts.copy()
    for f, k in zip(features, labels, strict=True):
        expected_counts[k] += 1
        expected[k] = (1 - 1 / expected_counts[k]) * expected[k] + f / expected_counts[k]
    np.testing.assert_allclose(moved.numpy(), expected, rtol=1e-12)
    np.testing.assert_array_equal(new_counts.numpy(), expected_counts)
    np.testing.assert_array_equal(moved[3].numpy(), centers[3])  # no members, no change


def test_three_dynamics_are_told_apart_with_five_clusters():
    demonstrations = three_dynamics((10, 20, 20))
    config = ClusteringConfig(
        subtrajectory_length=10,
        hidden=16,
        learning_rate=0.01,
        warmup_iterations=100,
        joint_iterations=100,
        num_clusters=5,
        reduction="mean",
    )
    clustering = ContrastiveClustering(demonstrations, config, root_seed=0)
    while clustering.iteration < clustering.num_iterations:
        clustering.update()
    labeling = clustering.model().label(demonstrations, draws=5, root_seed=0)

    report = diagnostics(labeling, demonstrations, 5)
    assert report.purity == 1.0
    assert report.label_stability > 0.7  # a mode may be split in two, and then a draw falls on either side
    np.testing.assert_allclose(np.linalg.norm(labeling.features, axis=1), 1, rtol=1e-5)
    # The frozen model finds the same dynamics in demonstrations that it has never seen.
    new = three_dynamics((10, 10, 10), seed=1)
    rebuilt = ClusterModel.from_arrays(clustering.model().arrays())
    owner = contingency(labeling.labels, demonstrations.sources, 5, 3).argmax(axis=0)
    found = rebuilt.label(new, draws=5, root_seed=0)
    assert (owner[found.labels] == new.sources).mean() > 0.9


def on_a_circle(*angles: np.ndarray) -> tuple[torch.Tensor, np.ndarray]:
    """Return unit features and the mode of each: one for every array of angles."""
    every = np.concatenate(angles)
    features = np.stack((np.cos(every), np.sin(every)), axis=1).astype(np.float32)
    return torch.from_numpy(features), np.repeat(np.arange(len(angles)), [len(each) for each in angles])


def is_alone(mode: int, modes: np.ndarray, labels: np.ndarray) -> bool:
    """Return whether a mode has a cluster of its own, and one only."""
    mine = np.unique(labels[modes == mode])
    return len(mine) == 1 and bool((modes[labels == mine[0]] == mode).all())


def kmeans_centers(features: torch.Tensor, num_clusters: int) -> torch.Tensor:
    """Return unit centers of k-means."""
    found = KMeans(num_clusters, n_init=10, random_state=0).fit(features.numpy())
    return normalize(torch.from_numpy(found.cluster_centers_), dim=-1)


def test_a_rare_mode_has_its_own_center_beside_a_wide_one():
    features, modes = on_a_circle(np.linspace(0, 2, 500), np.linspace(2.6, 2.65, 5))
    by_kmeans = kmeans_centers(features, 3)
    assert not is_alone(1, modes, assign(features, by_kmeans).numpy()), "k-means is enough: the test shows nothing"
    centers = clearer_centers(features, by_kmeans, linked_centers(features, 3))
    assert is_alone(1, modes, assign(features, centers).numpy())


def test_outliers_do_not_take_the_centers_of_modes():
    features, modes = on_a_circle(
        np.linspace(0, 0.3, 100), np.linspace(0.8, 1.1, 100), np.array([3.0]), np.array([4.5])
    )
    linked, by_kmeans = linked_centers(features, 3), kmeans_centers(features, 3)
    assert not is_alone(0, modes, assign(features, linked).numpy()), "linkage is enough: the test shows nothing"
    assert clearer_centers(features, by_kmeans, linked) is by_kmeans


@pytest.mark.parametrize("num_clusters", [1, 6])
def test_clusters_begin_where_there_is_nothing_to_compare(num_clusters: int):
    config = ClusteringConfig(**SMALL, num_clusters=num_clusters)
    assert len(ContrastiveClustering(three_dynamics((2, 2, 2)), config, 0).model().centers) == num_clusters


@pytest.mark.parametrize(("sufficient", "skipped"), [(0.75, False), (0.65, True)])
def test_the_warm_up_is_skipped_by_the_stability_of_kmeans(sufficient: float, skipped: bool):
    """Here it is 0.71; that of the groups of linkage, two of which are outliers, is 0.78."""
    config = ClusteringConfig(**SMALL, initial_centers="silhouette", sufficient_stability=sufficient)
    clustering = ContrastiveClustering(three_dynamics((30, 1, 1), seed=1), config, 0)
    assert clustering.iteration == (config.warmup_iterations if skipped else 0)


def test_a_model_without_training_data_for_a_center_leaves_that_cluster_empty():
    demonstrations = three_dynamics((3, 3, 3))
    model = ContrastiveClustering(demonstrations, ClusteringConfig(**SMALL, num_clusters=3), 0).model()
    features = model.label(demonstrations, draws=1, root_seed=0).features
    far = torch.stack((torch.from_numpy(features.mean(axis=0)), torch.full((16,), 9.0)))
    labeling = ClusterModel(
        model.encoder, far, torch.ones(2), model.sampling, model.state_mean, model.state_scale
    ).label(demonstrations, draws=2, root_seed=0)
    report = diagnostics(labeling, demonstrations, 2)
    assert report.cluster_sizes == (9, 0)
    assert (report.non_empty_clusters, report.silhouette, report.calinski_harabasz) == (1, None, None)


def test_diagnostics_by_hand():
    demonstrations = three_dynamics((2, 3, 1))
    features = np.array([[1, 0], [1, 0.1], [0, 1], [0.1, 1], [0, 1], [0.9, 0]], np.float32)
    labels = np.array([0, 0, 3, 3, 3, 0], np.int32)
    report = diagnostics(Labeling(labels, features, stability=0.75), demonstrations, num_clusters=4)
    assert report.contingency == ((2, 0, 0, 0), (0, 0, 0, 3), (1, 0, 0, 0))
    assert report.purity == pytest.approx(5 / 6)
    assert report.cluster_sizes == (3, 0, 0, 3)
    assert (report.num_clusters, report.non_empty_clusters, report.label_stability) == (4, 2, 0.75)
    assert report.silhouette == pytest.approx(silhouette_score(features, labels, metric="cosine"))
    assert report.calinski_harabasz == pytest.approx(calinski_harabasz_score(features, labels))
    assert purity(np.array([[2, 0], [2, 0]])) == 0.5


@pytest.mark.parametrize("reduction", ["sum", "mean"])
@pytest.mark.parametrize("centers", ["silhouette", "trajectories", "kmeans"])
@pytest.mark.parametrize("order", ["step_first", "centers_first"])
def test_every_reading_of_the_method_trains(reduction, centers, order):
    config = ClusteringConfig(**SMALL, num_clusters=3, reduction=reduction, initial_centers=centers, update_order=order)
    clustering = ContrastiveClustering(three_dynamics((4, 4, 4)), config, 0)
    first = clustering.update()
    while clustering.iteration < config.warmup_iterations:
        assert not clustering.counts.sub(100).any()  # centers rest while the encoder warms up
        last = clustering.update()
    assert last["contrastive_loss"] < first["contrastive_loss"]
    clustering.update()
    assert int(clustering.counts.sum()) == 3 * 100 + 2 * 12  # both views of all 12 demonstrations: fewer than a batch
    torch.testing.assert_close(clustering.centers.norm(dim=1), torch.ones(3))


def test_the_official_preset_trains_without_normalized_centers():
    config = ClusteringConfig.model_validate({"preset": "official", **SMALL, "subtrajectory_length": 7})
    clustering = ContrastiveClustering(three_dynamics((6, 6, 6)), config, 0)
    while clustering.iteration < clustering.num_iterations:
        clustering.update()
    assert clustering.model().sampling.stride == 7
    assert (clustering.centers.norm(dim=1) < 1).all()  # means of unit vectors that differ


def test_more_clusters_than_demonstrations_are_refused():
    with pytest.raises(DataError, match="3 demonstrations cannot form 5 clusters"):
        ContrastiveClustering(three_dynamics((1, 1, 1)), ClusteringConfig(num_clusters=5), 0)


def test_a_model_refuses_states_of_another_dimension_and_arrays_that_do_not_fit(demonstrations):
    model = ContrastiveClustering(three_dynamics((2, 2, 2)), ClusteringConfig(**SMALL, num_clusters=2), 0).model()
    wide = demonstrations(9)
    with pytest.raises(DataError, match="states have 3 dimensions"):
        model.label(wide, draws=1, root_seed=0)
    arrays = model.arrays()
    with pytest.raises(ValueError, match="no array 'stride'"):
        ClusterModel.from_arrays({name: value for name, value in arrays.items() if name != "stride"})
    with pytest.raises(ValueError, match="do not fit"):
        ClusterModel.from_arrays(arrays | {"lstm.weight_ih_l0": np.zeros((3, 3), np.float32)})


class Context:
    """A job's context that asks it to stop after so many iterations and keeps what was reported."""

    rollouts = None

    def __init__(self, stop_after: int | None = None, checkpoint_interval_s: float = 1e9) -> None:
        self.checkpoint_interval_s = checkpoint_interval_s
        self.stop_after = stop_after
        self.reports: list[tuple[int, int]] = []
        self.warnings: list[str] = []

    def progress(self, done: int, total: int, **metrics: float) -> None:
        assert np.isfinite(metrics["loss"])
        self.reports.append((done, total))

    def warn(self, message: str) -> None:
        self.warnings.append(message)

    def should_stop(self) -> bool:
        return len(self.reports) == self.stop_after


@pytest.fixture
def make_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Return a function that prepares a run whose demonstrations are those of three dynamics."""
    demonstrations = three_dynamics((4, 8, 8))
    monkeypatch.setattr(stage_module, "load_demonstrations", lambda run: demonstrations)

    def make(name: str, seed: int = 0, **clustering) -> Run:
        config = RunConfig.model_validate(
            {
                "name": name,
                "seed": seed,
                "environment": {"id": "oodil/Hopper-v0"},
                "demonstrations": {"file": "unused"},
                "clustering": {**SMALL, "num_clusters": 4, **clustering},
                "transferability": {"gail": {"total_steps": 1}},
                "imitation": {"gail": {"total_steps": 1}},
            }
        )
        directory = RunDirectory(tmp_path / name)
        write_artifact(directory.stage("demonstrations"), {}, {})
        return Run(config, directory)

    return make


STAGE = ClusteringStage()


def test_interrupted_and_resumed_equals_uninterrupted_to_the_bit(make_run):
    whole = STAGE.run_job(make_run("whole"), "clustering", Context())

    stopped = make_run("stopped")
    for after in (10, 20, 25):  # in the warm-up, when the centers are placed, among the joint iterations
        with pytest.raises(JobStoppedError):
            STAGE.run_job(stopped, "clustering", Context(stop_after=after))
    context = Context()
    assert STAGE.run_job(stopped, "clustering", context) == whole
    assert context.reports[0] == (56, 70) and context.reports[-1] == (70, 70)


def test_a_damaged_checkpoint_falls_back_to_the_one_before(make_run):
    whole = STAGE.run_job(make_run("whole"), "clustering", Context())
    run = make_run("damaged")
    with pytest.raises(JobStoppedError):
        STAGE.run_job(run, "clustering", Context(stop_after=40, checkpoint_interval_s=0))
    file = run.directory.checkpoints("clustering", "clustering") / f"{40:09d}" / "state.safetensors"
    file.write_bytes(file.read_bytes()[:-100])
    context = Context()
    assert STAGE.run_job(run, "clustering", context) == whole
    assert context.reports[0] == (40, 70)
    assert len(context.warnings) == 1 and f"{40:09d}" in context.warnings[0]


def test_a_finished_job_that_is_resumed_only_labels_again(make_run):
    run = make_run("twice")
    first = STAGE.run_job(run, "clustering", Context(checkpoint_interval_s=0))
    context = Context()
    assert STAGE.run_job(run, "clustering", context) == first
    assert context.reports == []


def test_the_files_of_the_stage(make_run):
    run = make_run("files")
    files = STAGE.run_job(run, "clustering", Context())
    artifact = write_artifact(run.directory.stage("clustering"), STAGE.origin(run), files)

    assignment = artifact.arrays("assignment.safetensors")
    assert assignment["labels"].dtype == np.int32 and assignment["labels"].shape == (20,)
    assert assignment["features"].dtype == np.float32 and assignment["features"].shape == (20, 16)
    model = ClusterModel.from_arrays(artifact.arrays("encoder.safetensors"))
    demonstrations = stage_module.load_demonstrations(run)
    np.testing.assert_array_equal(model.label(demonstrations, 5, root_seed=0).labels, assignment["labels"])
    report = ClusterDiagnostics.load(artifact)
    assert sum(report.cluster_sizes) == 20
    assert report.shortened_subtrajectories == 0
    assert len(report.contingency) == 3


def test_another_seed_gives_another_encoder(make_run):
    files = [STAGE.run_job(make_run(f"seed-{s}", seed=s), "clustering", Context()) for s in (0, 1)]
    assert files[0]["encoder.safetensors"] != files[1]["encoder.safetensors"]


def test_one_cluster_takes_everything_without_training(make_run):
    run = make_run("one", num_clusters=1)
    context = Context()
    artifact = write_artifact(run.directory.stage("clustering"), {}, STAGE.run_job(run, "clustering", context))
    assert context.reports == []
    assert not artifact.arrays("assignment.safetensors")["labels"].any()
    report = ClusterDiagnostics.load(artifact)
    assert report.cluster_sizes == (20,) and report.silhouette is None
    assert report.purity == pytest.approx(8 / 20)


def leaning(counts: tuple[int, int, int], seed: int = 0) -> Demonstrations:
    """Like `three_dynamics`, but each mode also has a level of its own, which shows without any training."""
    made = three_dynamics(counts, seed)
    level = np.array([-3.0, 0.0, 3.0], np.float32)[made.sources]
    return replace(made, observations=made.observations + np.repeat(level, made.lengths)[:, None])


@pytest.mark.parametrize(("make", "skipped"), [(leaning, True), (three_dynamics, False)])
def test_the_warm_up_is_left_out_where_clusters_are_stable_without_it(make, skipped):
    clustering = ContrastiveClustering(make((4, 50, 50)), ClusteringConfig(subtrajectory_length=10, num_clusters=3), 0)
    assert clustering.iteration == (200 if skipped else 0)
    assert bool(clustering.centers.any()) == skipped


def test_a_mode_with_few_members_keeps_a_cluster_of_its_own():
    demonstrations = leaning((4, 100, 100))
    clustering = ContrastiveClustering(demonstrations, ClusteringConfig(subtrajectory_length=10, hidden=64), 0)
    while clustering.iteration < 260:
        clustering.update()
    labels = clustering.model().label(demonstrations, draws=5, root_seed=0).labels
    assert not set(labels[:4]) & set(labels[4:])


def test_states_are_standardized_one_after_the_other_and_clustered_by_k_means():
    """Demonstrations of l states leave no choice of a sub-trajectory."""
    rng = np.random.default_rng(0)
    states = (rng.normal(size=(12, 5, 2)) * (1, 100) + np.repeat([0, 9, 20], 4)[:, None, None]).astype(np.float32)
    made = Demonstrations.of([Episode(each) for each in states], "made")
    model = clusters_of_states(made, ClusteringConfig(features="states", subtrajectory_length=5, num_clusters=3), 0)
    labeling = model.label(made, draws=3, root_seed=0)

    flat = ((states - states.mean(axis=(0, 1))) / states.std(axis=(0, 1))).reshape(12, 10)
    np.testing.assert_allclose(labeling.features, flat, rtol=1e-4, atol=1e-5)
    expected = KMeans(3, n_init=10, random_state=1).fit(flat)
    assert sorted(map(tuple, model.centers.numpy().round(3))) == sorted(
        map(tuple, expected.cluster_centers_.round(3).astype(np.float32))
    )
    np.testing.assert_array_equal(np.bincount(labeling.labels, minlength=3), model.counts.numpy())
    assert labeling.stability == 1


def test_states_of_every_stride_th_moment_say_which_dynamics_it_is(make_run):
    run = make_run("states", features="states", num_clusters=3)
    context = Context()
    files = STAGE.run_job(run, "clustering", context)
    artifact = write_artifact(run.directory.stage("clustering"), STAGE.origin(run), files)
    assert context.reports == [], "nothing is trained"
    assert files == STAGE.run_job(make_run("again", features="states", num_clusters=3), "clustering", Context())

    demonstrations, assignment = stage_module.load_demonstrations(run), Assignment.load(artifact)
    assert assignment.features.shape == (20, 20 * 2)
    rebuilt = ClusterModel.from_arrays(artifact.arrays("encoder.safetensors"))
    np.testing.assert_array_equal(rebuilt.label(demonstrations, 1, root_seed=0).labels, assignment.labels)
    report = ClusterDiagnostics.load(artifact)
    assert sum(report.cluster_sizes) == 20 and report.silhouette is not None
    assert report.label_stability < 1, "sub-trajectories with other phases fall into other clusters"
    with pytest.raises(ValueError, match="do not fit together: 40 numbers a center, 19 states of 2"):
        ClusterModel.from_arrays(rebuilt.arrays() | {"length": np.array([19], np.int32)})


def test_modes_that_lie_apart_are_found_in_states_and_in_new_demonstrations():
    known, new = leaning((4, 8, 8)), leaning((5, 5, 5), seed=1)
    model = clusters_of_states(known, ClusteringConfig(features="states", num_clusters=3), 0)
    labels = model.label(known, 1, root_seed=0).labels
    owner = contingency(labels, known.sources, 3, 3).argmax(axis=0)
    assert (owner[labels] == known.sources).all()
    assert (owner[model.label(new, 1, root_seed=0).labels] == new.sources).all()


def test_one_cluster_of_states_takes_everything_and_more_clusters_than_demonstrations_are_refused():
    made = three_dynamics((2, 2, 2))
    one = clusters_of_states(made, ClusteringConfig(features="states", num_clusters=1), 0)
    assert not one.label(made, 5, 0).labels.any()
    assert one.counts.tolist() == [6]
    with pytest.raises(DataError, match="6 demonstrations cannot form 7 clusters"):
        clusters_of_states(made, ClusteringConfig(features="states", num_clusters=7), 0)
