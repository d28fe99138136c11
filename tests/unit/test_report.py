"""The report: a synthetic run is written to disk as the stages would write it, then rendered."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from oodil.pipeline.artifacts import Artifact, RunDirectory, encode_arrays, encode_json, write_artifact
from oodil.pipeline.loading import parse_config
from oodil.pipeline.report import write_report
from oodil.pipeline.report.collection import Collection, Source
from oodil.pipeline.report.figures import source_looks
from oodil.pipeline.results import Results, summary
from oodil.pipeline.stage import Run

VERSIONS = {"numpy": "2.4.1", "torch": "2.13.0", "mujoco": "3.9.0"}
PAPER = {"gravity 15.0": True, "gravity 9.8": True, "gravity 2.0": False, "gravity 1.0": False}
VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}


def new_run(
    folder: Path, labels: list[str], counts: list[int], baselines: tuple[str, ...] = ("naive_gail", "oracle")
) -> Run:
    """Return a run in which nothing is finished yet."""
    folder.mkdir(exist_ok=True)
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

    def __init__(
        self, run: Run, transferable: dict[str, bool | None], counts: list[int], num_clusters: int = 5
    ) -> None:
        self.run = run
        self.transferable = transferable
        self.sources = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        self.num_clusters = num_clusters
        self.rng = np.random.default_rng(0)
        wanted = np.arange(len(counts)) % num_clusters
        stray = self.rng.random(len(self.sources)) < 0.03
        self.labels = np.where(stray, self.rng.integers(num_clusters, size=len(stray)), wanted[self.sources]).astype(
            np.int32
        )

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
        """About ten states each, so that the files stay small; sources differ in their returns."""
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
        centers = self.rng.normal(size=(self.num_clusters, 128))
        own = np.random.default_rng(1).normal(size=(int(self.sources.max()) + 1, 128))
        features = (
            centers[self.labels] + 0.5 * own[self.sources] + 0.75 * self.rng.normal(size=(len(self.sources), 128))
        )
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
        self.write(
            "clustering", {"assignment.safetensors": arrays, "diagnostics.json": diagnostics}, ("demonstrations",)
        )

    def scores(self) -> None:
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
            curve = (
                end
                + (0.45 - end) * np.exp(-6 * progress)
                - 0.5 * end * np.exp(-((progress - 0.25) ** 2) / 0.02)
                + noise
            )
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
            "env_steps": 5 * 1_500_000,
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

    def policy(
        self, stage: str, final_return: float, inputs: tuple[str, ...], episodes: int = 32, env_steps: int = 5_000_000
    ) -> None:
        """A learning curve that ends near the final return."""
        steps = np.linspace(400_000, env_steps, 12)
        mean = final_return * (1 - np.exp(-steps / 1.4e6)) + 60 * self.rng.normal(size=12)
        evaluation = {
            "final_return": final_return,
            "final_return_std": 0.08 * final_return,
            "final_length": 968.2,
            "episodes": episodes,
            "env_steps": env_steps,
        }
        curve = {"env_steps": steps.tolist(), "return_mean": mean.tolist(), "return_std": np.full(12, 210.0).tolist()}
        self.write(stage, {"evaluation.json": evaluation, "curve.json": curve, "policy.json": {}}, inputs)

    def events(self) -> None:
        """The log, with things in it that a reader has to pass over."""
        stages = {
            "demonstrations": 21.4,
            "clustering": 48.9,
            "transferability": 402.0,
            "imitation": 263.1,
            "naive_gail": 259.8,
        }
        lines = [{"time": 1.7e9, "event": "run_started", "workers": 2}, {"time": 1.7e9, "event": "something_new"}]
        lines += [
            {"time": 1.7e9, "event": "stage_finished", "stage": s, "seconds": t, "workers": 2}
            for s, t in stages.items()
        ]
        text = "".join(json.dumps(line) + "\n" for line in lines) + '[1, 2]\n{"event": "stage_fin'
        self.run.directory.events.write_text(text)


def full_run(
    folder: Path,
    transferable: dict[str, Any] = PAPER,
    counts: tuple[int, ...] = (10, 10, 250, 250),
    num_clusters: int = 5,
) -> Run:
    """Return a run in which everything is finished."""
    run = new_run(folder, list(transferable), list(counts))
    writer = Writer(run, transferable, list(counts), num_clusters)
    writer.demonstrations()
    writer.clustering()
    writer.scores()
    writer.policy("imitation", 2951.4, ("demonstrations", "transferability"))
    writer.policy("naive_gail", 846.3, ("demonstrations",))
    writer.policy("oracle", 3127.8, ("demonstrations",))
    writer.events()
    return run


SMALL: dict[str, Any] = {"transferable": {"heavy": True, "light": False}, "counts": (3, 5), "num_clusters": 2}
"""A run that renders in a moment."""


class Page(HTMLParser):
    """Checks that elements nest, and collects what the page refers to."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.references: list[str] = []
        self.text = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.references += [
            value or "" for name, value in attrs if name.split(":")[-1] in ("src", "href", "srcset", "data")
        ]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes another element"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text += data


def render(run: Run) -> Page:
    """Write the report and read it back; whatever the run, it must be a whole page that stands alone."""
    html = write_report(run).read_text(encoding="utf-8")
    page = Page(html)
    assert not page.open
    assert "script" not in page.tags and "link" not in page.tags
    assert all(reference.startswith(("#", "data:")) for reference in page.references)
    assert not re.search(r"https?://", re.sub(r'xmlns(:\w+)?="[^"]*"', "", html))
    assert not re.search(r"url\((?!#)|@import", html)
    assert "nan" not in re.findall(r"[a-z]+", page.text.lower())
    return page


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Page]:
    """A finished run of the paper's composition, and its report."""
    run = full_run(tmp_path_factory.mktemp("full"))
    return run, render(run)


def test_report_states_the_key_figures_of_the_artifacts(full: tuple[Run, Page]) -> None:
    _, page = full
    for figure in ("2,951", "846", "3,128", "3.9 %→53 %", "0.987", "0.967", "22.5 M", "16 min 35 s"):
        assert figure in page.text
    assert "3.5 times" in page.text  # 2951.4 / 846.3 = 3.487
    assert "520 demonstrations of 4 sources" in page.text
    assert "gravity 12" in page.text
    assert "One seed (3)" in page.text
    assert "Missing" not in page.text


def test_report_has_every_figure_and_the_source_of_its_numbers(full: tuple[Run, Page]) -> None:
    run, page = full
    assert page.tags.count("svg") == 4
    for label in ("by cluster", "by source", "cluster 4", "naive GAIL", "oracle", "Calinski-Harabasz 231.5", "t-SNE"):
        assert label in page.text
    for stage in ("demonstrations", "clustering", "transferability", "imitation", "naive_gail", "oracle"):
        assert run.artifact(stage).sha256 in page.text
    assert "torch 2.13.0" in page.text
    assert "center_weight: 0.01" in page.text  # of the resolved configuration


def test_summary_takes_the_figures_as_written(full: tuple[Run, Page]) -> None:
    assert summary(full[0]) == pytest.approx(
        {
            "final_return": 2951.4,
            "naive_return": 846.3,
            "oracle_return": 3127.8,
            "purity": 0.9673,
            "auroc": 0.9871,
            "transferable_share": 0.5312,
            "env_steps": 5 * 1_500_000 + 3 * 5_000_000,
            "seconds": 21.4 + 48.9 + 402.0 + 263.1 + 259.8,
        }
    )


def test_equal_runs_give_equal_bytes(tmp_path: Path) -> None:
    reports = [
        write_report(full_run(tmp_path / name, {"a": True, "b": False, "c": None}, (12, 12, 12), 3)).read_bytes()
        for name in ("one", "two")
    ]
    assert b"t-SNE" in reports[0]  # the figure most likely to differ
    assert reports[0] == reports[1]


@pytest.mark.parametrize("finished", range(6))
def test_a_partial_run_says_what_is_missing(tmp_path: Path, finished: int) -> None:
    run = new_run(tmp_path, list(SMALL["transferable"]), list(SMALL["counts"]))
    writer = Writer(run, **SMALL)
    steps = (
        writer.demonstrations,
        writer.clustering,
        writer.scores,
        lambda: writer.policy("imitation", 12.0, ("transferability",)),
        lambda: writer.policy("naive_gail", -3.5, ("demonstrations",)),
    )
    for step in steps[:finished]:
        step()
    names = ["demonstrations", "clustering", "transferability", "imitation", "naive GAIL", "oracle"]
    assert f"Missing: {', '.join(names[finished:])}, not finished." in render(run).text
    known = ["purity", "auroc", "transferable_share", "final_return", "naive_return"]
    after_stage = [2, 3, 3, 4, 5]
    expected = {key for key, stage in zip(known, after_stage, strict=True) if finished >= stage}
    assert set(summary(run)) == expected | ({"env_steps"} if finished >= 3 else set())


def test_a_baseline_that_was_not_asked_for_is_not_missing(tmp_path: Path) -> None:
    page = render(new_run(tmp_path, ["a"], [3], baselines=()))
    assert "Missing: demonstrations, clustering, transferability, imitation, not finished." in page.text
    assert page.text.count("not asked for") == 2


def test_labels_are_escaped(tmp_path: Path) -> None:
    label = '<script>alert("$x_1$")</script> & "more'
    run = full_run(tmp_path, {label: True, "it's": False}, (3, 4), 2)
    page = render(run)
    assert page.text.count(label) >= 4
    assert "<script" not in run.directory.report.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("transferable", "counts", "num_clusters"),
    [
        ({f"robot {i}": [True, False, None][i % 3] for i in range(30)}, (2,) * 30, 12),
        ({"only": None}, (4,), 1),
        ({"": None}, (40,), 3),
        ({"a": True, "b": False}, (2, 2), 2),
        ({"a": True}, (1,), 1),
    ],
    ids=[
        "thirty sources",
        "four demonstrations of one cluster",
        "no label",
        "four demonstrations",
        "one demonstration",
    ],
)
def test_unusual_sets(tmp_path: Path, transferable: dict[str, Any], counts: tuple[int, ...], num_clusters: int) -> None:
    page = render(full_run(tmp_path, transferable, counts, num_clusters))
    assert f"{sum(counts)} demonstration" in page.text
    assert all((label or "unnamed") in page.text for label in transferable)


def test_sources_may_be_unknown_and_features_trivial(tmp_path: Path) -> None:
    run = full_run(tmp_path, {"a": None}, (6,), 1)
    writer = Writer(run, {"a": None}, [6], 1)
    observations = run.artifact("demonstrations").arrays("demonstrations.safetensors")
    writer.write("demonstrations", {"demonstrations.safetensors": observations, "demonstrations.json": {}})
    trivial = {"labels": np.zeros(6, np.int32), "features": np.zeros((6, 0), np.float32)}
    diagnostics = {"num_clusters": 1, "purity": None, "silhouette": None}
    writer.write(
        "clustering", {"assignment.safetensors": trivial, "diagnostics.json": diagnostics}, ("demonstrations",)
    )
    page = render(run)
    assert "6 demonstrations; whose is not known." in page.text
    assert "There is no embedding to show" in page.text
    assert "purity" not in summary(run)


def test_artifacts_of_other_demonstrations_are_not_shown(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    Writer(run, SMALL["transferable"], [4, 4], 2).demonstrations()
    page = render(run)
    assert "Missing: clustering, naive GAIL, oracle, out of date, because demonstrations changed" in page.text
    assert "2,951" not in page.text
    assert set(summary(run)) == {"seconds"}


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    damaged = run.directory.stage("imitation") / "evaluation.json"
    damaged.write_text(damaged.read_text().replace("2951.4", "9951.4"))
    page = render(run)
    assert "Missing: imitation, damaged" in page.text
    assert str(damaged) in page.text
    assert "9,951" not in page.text
    assert "final_return" not in summary(run)
    (run.directory.stage("imitation") / "manifest.json").write_text("{")
    assert "Missing: imitation, damaged" in render(run).text


def test_weak_evaluations_are_called_weak(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    writer = Writer(run, **SMALL)
    writer.policy("naive_gail", 80.0, ("demonstrations",), episodes=4, env_steps=1_000_000)
    text = render(run).text
    assert "Few evaluation episodes (naive GAIL 4)" in text
    assert "imitation 5 M, naive GAIL 1 M, oracle 5 M environment steps" in text


def test_scores_that_favor_the_wrong_sources_are_called_out(tmp_path: Path, full: tuple[Run, Page]) -> None:
    told = "Weighting did not raise the transferable share"
    assert told not in full[1].text
    run = full_run(tmp_path, **SMALL)
    arrays = run.artifact("transferability").arrays("transferability.safetensors")
    worse = {"auroc": 0.2, "transferable_share": 0.1, "transferable_share_before": 0.3}
    files = {"transferability.safetensors": arrays, "summary.json": worse}
    Writer(run, **SMALL).write("transferability", files, ("demonstrations", "clustering"))
    assert told in render(run).text


def test_shares_of_the_sampling_mass_count_transitions() -> None:
    looks = source_looks([True, False])
    sources = [Source("a", True, 1, looks[0]), Source("b", False, 2, looks[1])]
    collection = Collection(sources, np.array([0, 1, 1], np.int32), np.array([6, 1, 1]), [None, None])
    assert collection.shares(collection.transitions.astype(float)) == pytest.approx([0.75, 0.25])  # 6 of 8
    weights = np.array([0.1, 0.3, 0.1])
    assert collection.shares(weights * collection.transitions) == pytest.approx([0.6, 0.4])  # 0.6 of 0.6 + 0.3 + 0.1


def test_no_two_sources_look_alike() -> None:
    for transferable in ([None] * 30, [i % 3 == 0 for i in range(30)], [True, False, None] * 10):
        assert len({(look.color, look.marker) for look in source_looks(transferable)}) == 30
    same, other = source_looks([True, False])
    assert source_looks([False, True]) == [other, same]


def test_a_failed_write_leaves_the_old_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = new_run(tmp_path, ["a"], [3])
    path = write_report(run)
    before = path.read_bytes()
    Writer(run, {"a": True}, [3], 1).demonstrations()

    def full_disk(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", full_disk)
        with pytest.raises(OSError, match="No space"):
            write_report(run)
    assert path.read_bytes() == before


def test_stage_times_are_those_of_the_last_computation(tmp_path: Path) -> None:
    run = new_run(tmp_path, ["a"], [3])
    lines = [
        {"event": "stage_interrupted", "stage": "clustering", "seconds": 20.0},
        {"event": "stage_started", "stage": "clustering", "jobs": 1},
        {"event": "stage_finished", "stage": "clustering", "seconds": 30.0},
        {"event": "stage_started", "stage": "transferability", "jobs": 5},
        {"event": "stage_finished", "stage": "transferability", "seconds": 300.0},
        {"event": "stage_started", "stage": "transferability", "jobs": 0},
        {"event": "stage_finished", "stage": "transferability", "seconds": 0.5},
        {"event": "stage_started", "stage": "imitation", "jobs": 1},
        {"event": "stage_finished", "stage": "imitation", "seconds": 90.0},
        {"event": "stage_started", "stage": "imitation", "jobs": 1},
        {"event": "stage_finished", "stage": "imitation", "seconds": 70.0},
        {"event": "stage_interrupted", "stage": "naive_gail", "seconds": 5.0},
        {"event": "stage_failed", "stage": "clustering", "seconds": 7.0},
    ]
    run.directory.events.write_text("\n".join(map(json.dumps, lines)))
    assert Results(run).seconds() == {"clustering": 50.0, "transferability": 300.5, "imitation": 70.0}
