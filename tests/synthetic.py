"""A synthetic run: its artifacts are written to disk as the stages would write them, and nothing is trained."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from oodil.pipeline.artifacts import Files, RunDirectory, write_artifact
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.loading import parse_config
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.results import (
    Assignment,
    ClusterDiagnostics,
    CollectedDemonstrations,
    Evaluation,
    LearningCurve,
    Policy,
    ScoreHistory,
    TrainedImitators,
    Training,
    Trainings,
    Transferability,
)
from oodil.pipeline.stage import Run, stage_named
from oodil.pipeline.stages import stages

VERSIONS = {"numpy": "2.4.1", "torch": "2.13.0", "mujoco": "3.9.0"}
PAPER = {"gravity 15.0": True, "gravity 9.8": True, "gravity 2.0": False, "gravity 1.0": False}


def new_run(
    folder: Path,
    marks: dict[str, bool | None],
    counts: tuple[int, ...],
    baselines: tuple[str, ...] = ("naive_gail", "oracle"),
    **sections: Any,
) -> Run:
    """Return a run in which nothing is finished yet."""
    folder.mkdir(exist_ok=True)
    sources = [
        {"label": label, "expert": "hand-written", "count": count, "transferable": mark}
        for (label, mark), count in zip(marks.items(), counts, strict=True)
    ]
    values = {
        "name": "hopper_1_1_25_25",
        "seed": 3,
        "environment": {"id": "oodil/Hopper-v0", "dynamics": {"gravity": 12.0}},
        "demonstrations": {"sources": sources},
        "transferability": {"gail": {"total_steps": 5_000_000}},
        "imitation": {"gail": {"total_steps": 5_000_000}},
        "baselines": baselines,
    }
    return Run(parse_config(values | sections, origin="test"), RunDirectory(folder))


def exact(scores: Any, weights: Any, clusters: Any) -> Transferability:
    """Scores without doubt."""
    return Transferability(scores, weights, clusters, np.stack((scores, scores), axis=1), threshold=0.5)


class Writer:
    """Writes the artifacts of a synthetic run, each a function of the seed, in the order of the stages."""

    def __init__(self, run: Run, num_clusters: int = 5) -> None:
        self.run = run
        self.known = [source.transferable for source in run.config.demonstrations.sources]
        counts = [source.count for source in run.config.demonstrations.sources]
        self.sources = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        self.num_clusters = num_clusters
        self.rng = np.random.default_rng(0)
        wanted = np.arange(len(counts)) % num_clusters
        stray = self.rng.random(len(self.sources)) < 0.03
        self.labels = np.where(stray, self.rng.integers(num_clusters, size=len(stray)), wanted[self.sources]).astype(
            np.int32
        )

    def write(self, stage: str, files: Files) -> None:
        """Write a stage's artifact, made by this code from what lies in the run, and empty ones of jobs that count."""
        known = stage_named(stage)
        for job in known.jobs(self.run) if known.jobs_are_read else ():
            write_artifact(self.run.directory.job(stage, job), known.job_origin(self.run, job), {}, VERSIONS)
        write_artifact(self.run.directory.stage(stage), known.origin(self.run), files, VERSIONS)

    def demonstrations(self) -> None:
        """About ten states each, so that the files stay small; sources differ in their returns."""
        lengths = self.rng.integers(8, 13, size=len(self.sources))
        episodes = [
            Episode(self.rng.normal(size=(length, 12)), 3200.0 + 50.0 * source)
            for source, length in zip(self.sources, lengths, strict=True)
        ]
        held = replace(
            Demonstrations.of(episodes, "source 0"),
            sources=self.sources,
            source_labels=tuple(f"source {i}" for i in range(len(self.known))),
        )
        self.write("demonstrations", CollectedDemonstrations(held, environment_id="oodil/Hopper-v0").files())

    def clustering(self, **changed: Any) -> None:
        """Blobs on the unit sphere, one per cluster, with a few strays."""
        centers = self.rng.normal(size=(self.num_clusters, 128))
        own = np.random.default_rng(1).normal(size=(len(self.known), 128))
        noise = 0.75 * self.rng.normal(size=(len(self.sources), 128))
        features = centers[self.labels] + 0.5 * own[self.sources] + noise
        features /= np.linalg.norm(features, axis=1, keepdims=True)
        contingency = np.zeros((len(self.known), self.num_clusters), int)
        np.add.at(contingency, (self.sources, self.labels), 1)
        diagnostics = ClusterDiagnostics(
            num_clusters=self.num_clusters,
            cluster_sizes=tuple(contingency.sum(axis=0).tolist()),
            label_stability=0.9731,
            silhouette=0.4127,
            calinski_harabasz=231.46,
            purity=0.9673,  # deliberately not what the contingency gives
            contingency=tuple(map(tuple, contingency.tolist())),
            shortened_subtrajectories=0,
        )
        features = changed.pop("features", features).astype(np.float32)
        files = Assignment(self.labels, features).files() | replace(diagnostics, **changed).files()
        self.write("clustering", files)

    def imitators(self) -> None:
        """What all of them together took."""
        self.write("imitators", TrainedImitators(5 * 1_500_000, {}).files())

    def scores(self, favored: bool | None = True) -> None:
        """High scores for what is favored; every curve starts near a half and ends at the scores."""
        high = np.array([mark in (favored, None) for mark in self.known])[self.sources]
        scores = np.where(high, self.rng.beta(22, 42, high.size), self.rng.beta(2, 45, high.size))
        history = {}
        progress = np.linspace(0.0, 1.0, 40)[:, None]
        steps = np.linspace(0, 1_500_000, 40).astype(np.int64)
        for k in np.unique(self.labels).tolist():
            members = np.flatnonzero(self.labels == k)
            end = scores[members][None]
            seen = end + (0.45 - end) * np.exp(-6 * progress)
            history[k] = ScoreHistory(members, steps, np.log(1 / seen - 1))
        band = np.clip(np.stack((scores - 0.03, scores + 0.03), axis=1), 0, 1)
        weights = scores / scores.sum()
        found = Transferability(scores, weights, self.labels, band, 0.2, env_steps=20_000, history=history)
        self.write("transferability", found.files())

    def marks(self) -> None:
        """One or zero."""
        scores = np.array([mark is True for mark in self.known], np.float64)[self.sources]
        none = np.full(len(scores), -1, np.int32)
        self.write("marks", exact(scores, scores / max(scores.sum(), 1), none).files())

    def policy(
        self,
        stage: str,
        mean: float,
        episodes: int = 32,
        env_steps: int = 5_000_000,
        points: int = 12,
        goes_on: bool = False,
    ) -> None:
        """A learning curve that ends near the final return; of the trainings the first is kept."""
        steps = np.linspace(400_000, env_steps, points).astype(np.int64)
        curve = LearningCurve(
            env_steps=steps,
            mean_return=mean * (1 - np.exp(-steps / 1.4e6)) + 60 * self.rng.normal(size=points),
            std_return=np.full(points, 210.0),
            mean_length=np.full(points, 968.0),
            episodes=7,
        )
        returns = mean + 0.08 * mean * np.where(np.arange(episodes) % 2, 1, -1)  # their mean is exactly ``mean``
        final = Evaluation(returns, np.full(episodes, 968))
        policy = Policy(
            gaussian=GaussianPolicy(
                weights=(np.zeros((12, 3), np.float32),),
                biases=(np.zeros(3, np.float32),),
                log_std=np.zeros(3, np.float32),
                input_mean=np.zeros(12, np.float32),
                input_scale=np.ones(12, np.float32),
            ),
            environment_id="oodil/Hopper-v0",
            observation_shape=(12,),
            action_low=-np.ones(3, np.float32),
            action_high=np.ones(3, np.float32),
            env_steps=env_steps,
        )
        kept = Training("training-2", goes_on, env_steps, env_steps, 0.2, final.mean_return)
        # No return decides which is kept.
        other = Training("training-1", False, env_steps, env_steps * 3 // 4, 0.3, 2 * final.mean_return)
        self.write(stage, policy.files() | curve.files() | final.files() | Trainings((kept, other)).files())

    def steps(self) -> dict[str, Callable[[], None]]:
        """Return what writes each stage, in their order."""
        return {
            "demonstrations": self.demonstrations,
            "clustering": self.clustering,
            "imitators": self.imitators,
            "transferability": self.scores,
            "imitation": lambda: self.policy("imitation", 2951.4),
            "naive_gail": lambda: self.policy("naive_gail", 846.3),
            "marks": self.marks,
            "oracle": lambda: self.policy("oracle", 3127.8),
        }

    def events(self) -> None:
        """The log, with lines that a reader has to pass over."""
        stages = {
            "demonstrations": 21.4,
            "clustering": 48.9,
            "imitators": 402.0,
            "imitation": 263.1,
            "naive_gail": 259.8,
        }
        lines = [{"time": 1.7e9, "event": "run_started", "workers": 2}, {"time": 1.7e9, "event": "something_new"}]
        lines += [{"time": 1.7e9, "event": "stage_finished", "stage": s, "seconds": t} for s, t in stages.items()]
        text = "".join(json.dumps(line) + "\n" for line in lines) + '[1, 2]\n{"event": "stage_fin'
        self.run.directory.events.write_text(text)


def full_run(
    folder: Path,
    marks: dict[str, Any] = PAPER,
    counts: tuple[int, ...] = (10, 10, 250, 250),
    num_clusters: int = 5,
) -> Run:
    """Return a run in which everything is finished."""
    baselines = ("naive_gail", "oracle") if True in marks.values() else ("naive_gail",)
    run = new_run(folder, marks, counts, baselines)
    writer = Writer(run, num_clusters)
    for stage in stages(run.config):
        writer.steps()[stage.name]()
    writer.events()
    return run


SMALL: dict[str, Any] = {"marks": {"heavy": True, "light": False}, "counts": (3, 5), "num_clusters": 2}
"""A run that renders in a moment."""
