"""The report: a synthetic run is written to disk as the stages would write it, then rendered."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.artifacts import Artifact, RunDirectory, encode_arrays, encode_json, write_artifact
from pipeline.config import parse_config
from pipeline.report import write_report
from pipeline.results import Results, summary
from pipeline.stage import Run

VERSIONS = {"numpy": "2.4.1", "torch": "2.13.0", "mujoco": "3.9.0"}
PAPER = {"gravity 15.0": True, "gravity 9.8": True, "gravity 2.0": False, "gravity 1.0": False}
VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}


def new_run(folder: Path, labels: list[str], counts: list[int], baselines: tuple[str, ...] = ("naive_gail", "oracle")) -> Run:
    """Return a run in which nothing is finished yet."""
    gail = {"total_steps": 5_000_000}
    sources = [
        {"label": label, "expert": "experts/any", "count": count, "transferable": n == 0}
        for n, (label, count) in enumerate(zip(labels, counts, strict=True))
    ]
    values = {
        "name": "hopper_1_1_25_25",
        "seed": 3,
        "environment": {"id": "oodil/Hopper-v0", "dynamics": {"gravity": 12.0}},
        "demonstrations": {"sources": sources},
        "transferability": {"gail": gail},
        "imitation": {"gail": gail},
        "baselines": baselines,
    }
    return Run(parse_config(values, origin="test"), RunDirectory(folder))


class Writer:
    """Writes the artifacts of a synthetic run, each a function of the seed, in the order of the stages."""

    def __init__(self, run: Run, transferable: dict[str, bool | None], counts: list[int], num_clusters: int = 5) -> None:
        self.run = run
        self.transferable = transferable
        self.sources = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        self.num_clusters = num_clusters
        self.rng = np.random.default_rng(0)
        wanted = np.arange(len(counts)) % num_clusters
        stray = self.rng.random(len(self.sources)) < 0.03
        self.labels = np.where(stray, self.rng.integers(num_clusters, size=len(stray)), wanted[self.sources]).astype(np.int32)

    def write(self, stage: str, files: dict[str, Any], inputs: tuple[str, ...] = ()) -> Artifact:
        """Write a stage's artifact: dictionaries of arrays become safetensors, everything else JSON."""
        hashes = {name: self.run.artifact(name).sha256 for name in inputs}
        encoded = {
            name: encode_arrays(value) if name.endswith(".safetensors") else encode_json(value)
            for name, value in files.items()
        }
        origin = {"stage": stage, "version": 1, "seed": 3, "settings": {}, "inputs": hashes}
        return write_artifact(self.run.directory.stage(stage), origin, encoded, VERSIONS)

    def demonstrations(self) -> None:
        """Ten states each, so that the files stay small; sources differ in their returns."""
        number = len(self.sources)
        lengths = self.rng.integers(8, 13, size=number)
        arrays = {
            "observations": self.rng.normal(size=(lengths.sum(), 12)).astype(np.float32),
            "offsets": np.cumsum([0, *lengths]).astype(np.int64),
            "sources": self.sources,
            "returns": 3200.0 + 50.0 * self.sources + self.rng.normal(size=number),
        }
        described = {
            "environment": {"id": "oodil/Hopper-v0", "dynamics": {"gravity": 12.0}},
            "source_labels": list(self.transferable),
            "transferable": list(self.transferable.values()),
        }
        self.write("demonstrations", {"demonstrations.safetensors": arrays, "demonstrations.json": described})

    def clustering(self) -> None:
        """Blobs on the unit sphere, one per cluster, with a few strays."""
        centres = self.rng.normal(size=(self.num_clusters, 128))
        own = np.random.default_rng(1).normal(size=(int(self.sources.max()) + 1, 128))
        features = centres[self.labels] + 0.5 * own[self.sources] + 0.75 * self.rng.normal(size=(len(self.sources), 128))
        features /= np.linalg.norm(features, axis=1, keepdims=True)
        sizes = np.bincount(self.labels, minlength=self.num_clusters)
        contingency = {
            label: np.bincount(self.labels[self.sources == i], minlength=self.num_clusters).tolist()
            for i, label in enumerate(self.transferable)
        }
        diagnostics = {
            "num_clusters": self.num_clusters,
            "non_empty_clusters": int((sizes > 0).sum()),
            "cluster_sizes": sizes.tolist(),
            "silhouette": 0.4127,
            "calinski_harabasz": 231.46,
            "label_stability": 0.9731,
            "purity": 0.9673,  # deliberately not what the contingency gives
            "contingency": contingency,
        }
        arrays = {"labels": self.labels, "features": features.astype(np.float32)}
        self.write("clustering", {"assignment.safetensors": arrays, "diagnostics.json": diagnostics}, ("demonstrations",))

    def transferability_stage(self) -> None:
        """High scores for what is transferable; every curve starts near a half and parts from the others."""
        known = np.array([value is not False for value in self.transferable.values()])[self.sources]
        scores = np.where(known, self.rng.beta(22, 42, known.size), self.rng.beta(2, 45, known.size))
        offsets = self.run.artifact("demonstrations").arrays("demonstrations.safetensors")["offsets"]
        weights = scores / (scores * (np.diff(offsets) - 1)).sum()
        history: dict[str, NDArray] = {}
        progress = np.linspace(0.0, 1.0, 40)[:, None]
        for k in np.unique(self.labels):
            members = np.flatnonzero(self.labels == k)
            end = scores[members][None]
            noise = 0.02 * self.rng.normal(size=(40, members.size)) + 0.01 * self.rng.normal(size=(40, 1))
            curve = end + (0.45 - end) * np.exp(-6 * progress) - 0.5 * end * np.exp(-((progress - 0.25) ** 2) / 0.02) + noise
            history[f"cluster_{k}/env_steps"] = np.linspace(0, 1_500_000, 40).astype(np.int64)
            history[f"cluster_{k}/scores"] = np.clip(curve, 0.001, 0.999)
            history[f"cluster_{k}/demonstrations"] = members
        mean_scores = {label: float(scores[self.sources == i].mean()) for i, label in enumerate(self.transferable)}
        described = {
            "auroc": 0.9871,  # deliberately not what the scores give
            "transferable_share": 0.5312,
            "transferable_share_before": 0.0391,
            "mean_score_by_source": mean_scores,
            "sharpening": 1.0,
        }
        arrays = {"scores": scores, "weights": weights, "clusters": self.labels}
        self.write(
            "transferability",
            {
                "transferability.safetensors": arrays,
                "history.safetensors": history,
                "summary.json": described,
            },
            ("demonstrations", "clustering"),
        )

    def policy(self, stage: str, final_return: float, inputs: tuple[str, ...], episodes: int = 32) -> None:
        """A learning curve that ends near the final return."""
        steps = np.linspace(400_000, 5_000_000, 12)
        mean = final_return * (1 - np.exp(-steps / 1.4e6)) + 60 * self.rng.normal(size=12)
        evaluation = {
            "final_return": final_return,
            "final_return_std": 0.08 * final_return,
            "final_length": 968.2,
            "episodes": episodes,
            "env_steps": 5_000_000,
        }
        curve = {"env_steps": steps.tolist(), "return_mean": mean.tolist(), "return_std": np.full(12, 210.0).tolist()}
        self.write(stage, {"evaluation.json": evaluation, "curve.json": curve, "policy.json": {}}, inputs)

    def events(self) -> None:
        """The log, with things in it that a reader has to pass over."""
        stages = {"demonstrations": 21.4, "clustering": 48.9, "transferability": 402.0, "imitation": 263.1, "naive_gail": 259.8}
        lines = [{"time": 1.7e9, "event": "run_started", "workers": 2}, {"time": 1.7e9, "event": "something_new"}]
        lines += [{"time": 1.7e9, "event": "stage_finished", "stage": s, "seconds": t, "workers": 2} for s, t in stages.items()]
        text = "".join(json.dumps(line) + "\n" for line in lines) + '[1, 2]\n{"event": "stage_fin'
        self.run.directory.events.write_text(text)


def full_run(
    folder: Path, transferable: dict[str, Any] = PAPER, counts: tuple[int, ...] = (10, 10, 250, 250), num_clusters: int = 5
) -> Run:
    """Return a run in which everything is finished."""
    run = new_run(folder, list(transferable), list(counts))
    writer = Writer(run, transferable, list(counts), num_clusters)
    writer.demonstrations()
    writer.clustering()
    writer.transferability_stage()
    writer.policy("imitation", 2951.4, ("demonstrations", "transferability"))
    writer.policy("naive_gail", 846.3, ("demonstrations",))
    writer.policy("oracle", 3127.8, ("demonstrations",))
    writer.events()
    return run
