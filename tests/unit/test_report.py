"""The report: a synthetic run is written to disk as the stages would write it, then rendered."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from oodil.pipeline import stage as stage_module
from oodil.pipeline.artifacts import Files
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.environments.driving_world import layout
from oodil.pipeline.errors import StorageError
from oodil.pipeline.loading import parse_config
from oodil.pipeline.metrics import Metrics
from oodil.pipeline.report import Report, context, formats, looks, paths, summary, write_report
from oodil.pipeline.report.looks import contrast, source_looks
from oodil.pipeline.report.sources import Source, Sources, ranks_demonstrations
from oodil.pipeline.report.summary import Findings
from oodil.pipeline.report.trainings import read_trainings
from oodil.pipeline.results import Reproducibility, ScoreHistory, Transferability
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import JobContext, Run, register
from oodil.pipeline.stages import PolicyStage, Weighting
from tests.synthetic import PAPER, SMALL, Writer, exact, full_run, new_run

VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}


@pytest.fixture(autouse=True, scope="module")
def blind() -> Iterator[None]:
    """Nothing can be rendered, which would take most of the time here; tests/integration/test_video.py films."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", "disabled")
        yield


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
            self.text += data.replace("\u00a0", " ")


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


def contents(run: Run) -> Report:
    """Return what the page shows of a run as it lies on disk now."""
    return context(RunResults(run))


def notes(run: Run) -> str:
    """Return the notes of a run."""
    told = summary.notes(Findings.of(RunResults(run)))
    return "\n".join(note.lead + note.text for note in told).replace("\u00a0", " ")


def cards(run: Run) -> dict[str, str]:
    """Return the figures of the cards by title."""
    return {card.title: card.figure.replace("\u00a0", " ") for card in summary.cards(Findings.of(RunResults(run)))}


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Page]:
    """A finished run of the paper's composition, and its report."""
    run = full_run(tmp_path_factory.mktemp("full"))
    return run, render(run)


def test_the_cards_hold_the_key_figures(full: tuple[Run, Page]) -> None:
    run, page = full
    separation = RunResults(run).separation()
    assert cards(run) == {
        "Final return, ours": "2,951",
        "Final return, naive GAIL": "846",
        "Final return, oracle": "3,128",
        "Demonstrations kept": str(sum(row.kept for row in RunResults(run).verdicts().by_source)),
        "Transferable share": f"{100 * separation['share']:.0f} %",
        "AUROC": f"{separation['auroc']:.3f}",
        "Purity of clusters": "0.967",
        "Environment steps": "37.5 M",  # 5 x 1.5 M of the imitators, 20 k of their scores, 3 x 2 x 5 M of the policies
        "Time": "16 min 35 s",  # 21.4 + 48.9 + 402.0 + 263.1 + 259.8 = 995.2
    }
    assert f"{100 * separation['share_before']:.1f} %→{100 * separation['share']:.0f} %" in page.text
    assert all(figure in page.text for figure in cards(run).values())


def test_the_top_of_the_page_says_what_was_run(full: tuple[Run, Page]) -> None:
    _, page = full
    # 2951.4 / 846.3 = 3.487 and 2951.4 / 3127.8 = 0.944
    finding = "The policy “ours” returns 2,951 on average, 3.5 times the return of naive GAIL (846) and "
    finding += "0.94 times the return of oracle (3,128)."
    assert finding in page.text
    assert "520 demonstrations of 4 sources" in page.text
    assert "gravity 12" in page.text
    assert "One seed (3)" in page.text
    assert "Missing" not in page.text


def test_report_has_every_figure_and_the_source_of_its_numbers(full: tuple[Run, Page]) -> None:
    run, page = full
    assert page.tags.count("svg") == 4
    for label in ("by cluster", "by source", "cluster 4", "naive GAIL", "oracle", "Calinski-Harabasz 231.5", "t-SNE"):
        assert label in page.text
    for stage in RunResults(run).states:
        assert run.artifact(stage).sha256[:12] in page.text and run.artifact(stage).sha256 not in page.text
    assert "torch 2.13.0" in page.text
    assert "center_weight: 0.01" in page.text  # of the resolved configuration


def test_episodes_of_a_curve_are_those_that_it_was_made_with(full: tuple[Run, Page]) -> None:
    run, page = full
    assert run.config.evaluation.episodes != 7
    assert "7 episodes per point" in page.text


def test_weightings_that_repeat_what_is_known_have_no_figure_of_their_own(full: tuple[Run, Page]) -> None:
    report = contents(full[0])
    assert [weighting.title for weighting in report.weightings] == ["ours"]
    assert report.mixture is not None
    assert [bar.title for bar in report.mixture.bars] == ["unweighted", "weighting “ours”", "weighting “marks”"]
    assert report.mixture.reproducibility == ""  # it was not asked for
    assert sum(share for source, share in report.mixture.bars[2].shares if source.transferable) == pytest.approx(1)
    assert report.policies is not None
    assert [(row.title, row.weighting) for row in report.policies.rows] == [
        ("ours", "ours"),
        ("naive GAIL", ""),
        ("oracle", "marks"),
    ]


def test_verdicts_and_other_weights_are_on_the_page(full: tuple[Run, Page]) -> None:
    run, page = full
    section = contents(run).weightings[0]
    found, separation = RunResults(run).verdicts(), RunResults(run).separation()
    assert [(source.label, row.name) for source, row in section.by_source] == [(label, label) for label in PAPER]
    assert tuple(row for _, row in section.by_source) == found.by_source
    assert section.by_cluster == found.by_cluster
    assert {title: share for title, share, _ in section.alternatives} == {
        "none": separation["share_before"],
        "the rule": separation["share"],
        "score": separation["share_power_1"],
        "score to the power of 2": separation["share_power_2"],
        "score to the power of 4": separation["share_power_4"],
        "score to the power of 8": separation["share_power_8"],
    }
    assert section.alternatives[0][2] == pytest.approx(520)
    assert section.alternatives[1][2] == pytest.approx(found.effective_number)
    for text in (
        "cannot be told from the imitator's own fresh episodes",
        "The rule of weights: a demonstration is drawn for imitation in proportion to its score, if the whole",
        "reaches 0.200, the dashed line",
        "kept from 0.200",
        "Diamond: the score",
        f"{found.by_source[0].kept} of 10 kept",
    ):
        assert text in " ".join(page.text.split()), text


def test_the_trainings_of_a_policy_begin_with_the_one_that_was_kept(full: tuple[Run, Page]) -> None:
    policies = contents(full[0]).policies
    assert policies is not None
    steps = policies.rows[0].env_steps
    assert steps is not None
    assert [(row.policy, row.name, row.kept, row.kept_after, row.distance) for row in policies.trainings[:2]] == [
        ("ours", "training 2", True, steps, "0.200"),
        ("ours", "training 1", False, steps * 3 // 4, "0.300"),
    ]
    assert policies.trainings[1].mean_return == pytest.approx(2 * 2951.4)
    assert "The trainings of each policy" in full[1].text


def test_the_embedding_suggests_a_number_of_clusters(full: tuple[Run, Page]) -> None:
    clusters = contents(full[0]).clusters
    assert clusters is not None
    assert clusters.suggestion.startswith("K suggested by the embedding: ")
    assert clusters.suggestion in full[1].text


@pytest.mark.parametrize(
    ("light", "told"),
    [
        (0.01, "Every source can be reproduced"),
        (0.2, "cannot follow the demonstrations of: light."),
        (np.nan, "cannot follow the demonstrations of: light."),
    ],
)
def test_what_can_be_reproduced_is_said(tmp_path: Path, light: float, told: str) -> None:
    run = new_run(tmp_path, SMALL["marks"], SMALL["counts"], reproducibility={})
    writer = Writer(run, 2)
    writer.demonstrations()
    distances = np.where(writer.sources == 0, 0.012, light)[:, None].repeat(4, axis=1)
    writer.write("reproducibility", Reproducibility(distances, distances).files())
    for name in ("clustering", "imitators", "transferability"):
        writer.steps()[name]()
    mixture, page = contents(run).mixture, render(run)
    assert mixture is not None and told in mixture.reproducibility and told in page.text
    assert mixture.columns[-1] == "can be reproduced (distance)"
    assert mixture.rows[0].cells[-1] == "yes (0.012)"
    expected = "yes (0.010)" if light == 0.01 else "no (0.200)" if light == 0.2 else "not known"
    assert mixture.rows[1].cells[-1] == expected


def test_scores_may_all_be_the_same(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    writer, zeros = Writer(run, 2), np.zeros(8)
    history = {0: ScoreHistory(np.arange(8), np.array([0, 1]), np.full((2, 8), np.inf))}
    found = Transferability(zeros, np.full(8, 1 / 8), writer.labels, np.zeros((8, 2)), 0.0, history=history)
    writer.write("transferability", found.files())
    assert "mean score of only 0.000" in notes(run)
    render(run)


class LengthWeighting(Weighting):
    """A method as somebody may register it: long demonstrations weigh more."""

    name = "by_length"
    title = "by length"
    version = 1
    inputs = ("demonstrations",)

    def settings(self, config: RunConfig) -> dict[str, Any]:
        return {}

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        raise NotImplementedError

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        raise NotImplementedError


def test_a_registered_method_appears(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_module, "_REGISTRY", dict(stage_module._REGISTRY))  # forgets them afterwards
    register(LengthWeighting())
    register(PolicyStage("longest", title="longest first", weighting=LengthWeighting.name))
    run = new_run(tmp_path, SMALL["marks"], SMALL["counts"], baselines=("longest",))
    writer = Writer(run, 2)
    for name in ("demonstrations", "clustering", "imitators", "transferability", "imitation"):
        writer.steps()[name]()
    assert "Missing: by_length, longest, not computed yet." in render(run).text
    lengths = RunResults(run).demonstrations.lengths
    none = np.full(len(lengths), -1, np.int32)
    writer.write("by_length", exact(lengths / 20, lengths / lengths.sum(), none).files())
    writer.policy("longest", 1500.0)
    page = render(run)
    assert page.tags.count("svg") == 5
    for text in ("Weighting “by length”", "weighting “by length”", "Final return, longest first", "AUROC, by length"):
        assert text in page.text
    assert "2.0 times the return of longest first (1,500)" in page.text
    assert "Missing" not in page.text


def test_the_contingency_is_by_source_whatever_it_is_called(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    renamed = Run(new_run(tmp_path, {"new": True, "name": False}, SMALL["counts"]).config, run.directory)
    clusters, expected = contents(renamed).clusters, RunResults(run).cluster_diagnostics.contingency
    assert clusters is not None
    assert [(row.source.label, tuple(n for n, _ in row.cells)) for row in clusters.contingency] == [
        ("new", expected[0]),
        ("name", expected[1]),
    ]


def test_equal_runs_give_equal_bytes(tmp_path: Path) -> None:
    reports = [
        write_report(full_run(tmp_path / name, {"a": True, "b": False, "c": None}, (12, 12, 12), 3)).read_bytes()
        for name in ("one", "two")
    ]
    assert b"t-SNE" in reports[0]  # the figure most likely to differ
    assert reports[0] == reports[1]


@pytest.mark.parametrize("finished", range(9))
def test_a_partial_run_says_what_is_missing(tmp_path: Path, finished: int) -> None:
    run = new_run(tmp_path, SMALL["marks"], SMALL["counts"])
    writer, names = Writer(run, 2), list(RunResults(run).states)
    for name in names[:finished]:
        writer.steps()[name]()
    page = render(run)
    if names[finished:]:
        assert f"Missing: {', '.join(names[finished:])}, not computed yet." in page.text
    else:
        assert "Missing" not in page.text
    assert ("It learns from" in page.text) == (finished >= 1)
    assert ("not clustered yet" in page.text) == (finished < 2)
    assert ("not known yet" in page.text) == (finished < 4)
    assert ("No policy is trained yet" in page.text) == (finished < 5)
    assert ("returns 2,951 on average" in page.text) == (finished >= 5)


def test_a_begun_stage_is_not_finished(tmp_path: Path) -> None:
    run = new_run(tmp_path, SMALL["marks"], SMALL["counts"])
    run.directory.checkpoints("demonstrations", "source-0").mkdir(parents=True)
    assert "Missing: demonstrations, not finished." in notes(run)


def test_policies_that_were_not_asked_for_are_not_on_the_page(tmp_path: Path) -> None:
    run = new_run(tmp_path, {"a": True}, (3,), baselines=())
    page = render(run)
    states = "demonstrations, clustering, imitators, transferability, imitation"
    assert f"Missing: {states}, not computed yet." in page.text
    assert not re.search(r"naive GAIL|\boracle\b", page.text)


def test_labels_are_escaped(tmp_path: Path) -> None:
    label = '<script>alert("$x_1$")</script> & "more'
    run = full_run(tmp_path, {label: True, "it's": False}, (3, 4), 2)
    page = render(run)
    assert page.text.count(label) >= 4
    assert "<script" not in run.directory.report.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("marks", "counts", "num_clusters"),
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
def test_unusual_sets(tmp_path: Path, marks: dict[str, Any], counts: tuple[int, ...], num_clusters: int) -> None:
    page = render(full_run(tmp_path, marks, counts, num_clusters))
    assert f"{sum(counts)} demonstration" in page.text
    assert all((label or "unnamed") in page.text for label in marks)


def test_sources_may_be_unknown_and_features_trivial(tmp_path: Path) -> None:
    run = full_run(tmp_path, {"a": None}, (6,), 1)
    unknown = {"silhouette": None, "calinski_harabasz": None}
    Writer(run, 1).clustering(features=np.zeros((6, 0)), **unknown)
    page = render(run)
    assert "It learns from 6 demonstrations." in page.text
    assert "There is no embedding to show" in page.text
    assert "Calinski" not in page.text
    assert "neither AUROC nor the transferable share" in page.text
    assert "AUROC" not in cards(run)


def test_stale_stages_are_not_shown_and_named_with_the_reason(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    changed = new_run(tmp_path, SMALL["marks"], SMALL["counts"], transferability={
        "gail": {"total_steps": 5_000_000}, "kept_from": 0.3,
    })  # fmt: skip
    page = render(changed)
    assert "Missing: transferability, stale: kept_from 0.5 -> 0.3." in page.text
    assert "Missing: imitation, stale: its input transferability is stale." in page.text
    assert "2,951" not in page.text and "846" in page.text
    assert "weighting “marks”" in page.text and "weighting “ours”" not in page.text
    Writer(run, 3).demonstrations()
    assert "Missing: clustering, imitators, transferability" not in notes(run), "equal content"
    writer = Writer(run, 3)
    writer.rng = np.random.default_rng(5)
    writer.demonstrations()
    page = render(run)
    assert "stale: its input demonstrations changed" in page.text
    assert "2,951" not in page.text and "846" not in page.text
    assert "-> " not in page.text


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    folder = run.directory.stage("imitation")
    damaged = next(path for path in folder.iterdir() if b'"returns"' in path.read_bytes())
    damaged.write_text(damaged.read_text().replace("2715.2", "9715.2"))
    page = render(run)
    assert "Missing: imitation, damaged" in page.text
    assert f"{damaged.relative_to(run.directory.path)}" in page.text and str(tmp_path) not in page.text
    assert "returns" not in summary.finding(Findings.of(RunResults(run)))
    (folder / "manifest.json").write_text("{")
    assert "Missing: imitation, damaged" in notes(run)


def test_weak_evaluations_are_called_weak(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    Writer(run, 2).policy("naive_gail", 80.0, episodes=4, env_steps=1_000_000)
    assert "over few episodes (naive GAIL 4)" in notes(run)
    assert "(ours 5 M, naive GAIL 1 M, oracle 5 M)" in notes(run)


def test_what_ours_begins_with_and_takes_in_all_is_said(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    results = RunResults(run)
    ours, naive = results.policies[:2]
    steps = results.env_steps()
    # Of the imitators, the readings, and the policy.
    assert results.env_steps_of(ours) == 5 * 1_500_000 + 20_000 + steps["imitation"]
    assert results.env_steps_of(naive) == steps["naive_gail"]
    begins = "goes on from the imitator of a cluster"
    assert begins not in notes(run) and "ours took 17.5 M environment steps" in notes(run)
    Writer(run, 2).policy("imitation", 3000.0, goes_on=True)
    assert begins in notes(run)


def test_returns_may_be_unknown_negative_or_without_a_curve(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    writer = Writer(run, 2)
    writer.policy("naive_gail", -3.5, points=0)
    writer.policy("oracle", float("nan"))
    page = render(run)
    assert "returns 2,951 on average, against -3.5 of naive GAIL." in page.text
    assert cards(run)["Final return, oracle"] == "–"
    assert "naive GAIL" in Page(str(contents(run).policies.figure)).text  # type: ignore[union-attr]
    writer.policy("imitation", float("nan"))
    assert "returns 2,951" not in render(run).text


def test_scores_that_favor_the_wrong_sources_are_called_out(tmp_path: Path, full: tuple[Run, Page]) -> None:
    told = "The weighting “ours” does not raise the transferable share"
    assert told not in full[1].text
    run = full_run(tmp_path, **SMALL)
    Writer(run, 2).scores(favored=False)
    assert told in notes(run)


def test_unstable_clusters_are_called_out(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    Writer(run, 2).clustering(label_stability=0.41)
    assert "clusters are unstable" in notes(run) and "41 %" in notes(run)


def write_metrics(run: Run, stage: str, job: str, rows: list[dict[str, float]]) -> None:
    """Write the metrics of a job, as its process does."""
    with Metrics(run.directory.metrics(stage, job)) as metrics:
        for row in rows:
            metrics.write(int(row["step"]), 5000, {name: value for name, value in row.items() if name != "step"})


def test_trainings_are_drawn_where_there_are_metrics(tmp_path: Path) -> None:
    run = full_run(tmp_path, **SMALL)
    assert "How the trainings went" not in render(run).text
    rows = [
        {"step": 1000.0 * i, "demonstration_accuracy": 0.9, "policy_accuracy": 1 - 0.1 * i}
        | ({"return": 100.0 * i} if i else {})  # no episode has ended yet
        for i in range(4)
    ]
    write_metrics(run, "imitators", "cluster-1", rows)
    write_metrics(run, "imitators", "cluster-0", rows[:1])  # too short for a curve
    write_metrics(run, "imitators", "cluster-7", rows)  # of an earlier clustering
    write_metrics(run, "naive_gail", "training-1", [row | {"return": float("nan")} for row in rows])
    write_metrics(run, "clustering", "clustering", [{"step": 1.0, "loss": 2.0}, {"step": 2.0, "loss": 1.0}])
    trainings = read_trainings(RunResults(run))
    assert {group: [each.title for each in held] for group, held in trainings.items()} == {
        "imitators": ["cluster 1"],
        "policies": ["naive GAIL, training 1"],
    }
    drawn = trainings["imitators"][0]
    np.testing.assert_allclose(drawn.policy_accuracy, [1.0, 0.9, 0.8, 0.7])
    np.testing.assert_array_equal(drawn.env_return, [np.nan, 100.0, 200.0, 300.0])
    page = render(run)
    assert "How the trainings went" in page.text
    assert page.tags.count("svg") == 6


def small_sources(scores: list[float]) -> tuple[Sources, Transferability]:
    """Return one demonstration of 6 transitions of a source, and two of 1 transition of another."""
    looks = source_looks([True, False])
    each = (Source("a", True, 1, 5.0, looks[0]), Source("b", False, 2, 5.0, looks[1]))
    episodes = [Episode(np.zeros((length, 2))) for length in (7, 2, 2)]
    held = replace(Demonstrations.of(episodes, "a"), sources=np.array([0, 1, 1], np.int32), source_labels=("a", "b"))
    without_clusters = np.full(3, -1, np.int32)
    return Sources(each, held), exact(np.array(scores), np.ones(3) / 3, without_clusters)


def test_shares_of_the_sampling_mass_count_transitions() -> None:
    sources, _ = small_sources([0.1, 0.2, 0.3])
    assert sources.shares(np.ones(3)) == pytest.approx([0.75, 0.25])  # 6 of 8
    assert sources.shares(np.array([0.1, 0.3, 0.1])) == pytest.approx([0.6, 0.4])  # 0.6 of 0.6 + 0.3 + 0.1


def test_a_weighting_ranks_demonstrations_if_it_tells_those_of_a_source_apart() -> None:
    sources, constant = small_sources([1.0, 0.0, 0.0])
    assert not ranks_demonstrations(constant, sources)
    assert ranks_demonstrations(small_sources([1.0, 0.0, 0.1])[1], sources)
    assert ranks_demonstrations(replace(constant, clusters=np.zeros(3, np.int32)), sources)


def test_no_two_sources_look_alike() -> None:
    for marks in ([None] * 30, [i % 3 == 0 for i in range(30)], [True, False, None] * 10):
        assert len({(look.color, look.marker) for look in source_looks(marks)}) == 30
    same, other = source_looks([True, False])
    assert source_looks([False, True]) == [other, same]


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_text_and_marks_can_be_seen(dark: bool) -> None:
    """4.5 for text and 3 for marks, on the page and on its soft panels, for readers of either mode."""
    assert contrast("#000000", "#ffffff") == pytest.approx(21)

    def shown(color: str) -> str:
        return looks.DARK.get(color, color) if dark else color

    for paper in (looks.PAPER, looks.SOFT):
        for color in (looks.INK, looks.MUTED, *looks.POLICIES):
            assert contrast(shown(color), shown(paper)) >= 4.5, (color, paper)
        sources = (*looks.TRANSFERABLE, *looks.NOT_TRANSFERABLE, *looks.UNKNOWN, *looks.UNMARKED)
        for color in (*sources, *looks.CLUSTERS, *looks.TRAINING, looks.LINES):
            assert contrast(shown(color), shown(paper)) >= 3, (color, paper)
    for marks in ([None] * 8, [True] * 5, [False] * 5):
        assert all(contrast(look.text, look.color) >= 4.5 for look in source_looks(marks))


def test_few_sources_differ_in_shape_as_well_as_in_color() -> None:
    for marks in ([True, True, False, False], [True, True, True, False, False, False, False], [None] * 7):
        assert len({look.marker for look in source_looks(marks)}) == len(marks)


def test_colors_of_the_page_are_those_that_follow_the_mode(full: tuple[Run, Page]) -> None:
    html = full[0].directory.report.read_text()
    for light, color in looks.DARK.items():
        assert f"--{light[1:]}: {color};" in html
    assert f"var(--{looks.INK[1:]},{looks.INK})" in html and "prefers-color-scheme: dark" in html


def test_the_best_and_the_worst_demonstrations_have_their_numbers(full: tuple[Run, Page]) -> None:
    run, page = full
    scores = RunResults(run).transferability.scores
    order = np.argsort(-scores, kind="stable")
    ranks = contents(run).weightings[0].ranks
    assert [row.number for row in ranks] == [*order[:5], *order[-5:]]
    assert [row.rank for row in ranks] == [1, 2, 3, 4, 5, 516, 517, 518, 519, 520]
    assert [row.score for row in ranks] == [*scores[order[:5]], *scores[order[-5:]]]
    assert ranks[0].source.label == list(PAPER)[RunResults(run).demonstrations.sources[order[0]]]
    assert "The best and the worst demonstrations" in page.text


def test_the_verdict_comes_first(full: tuple[Run, Page]) -> None:
    run, page = full
    rows = RunResults(run).verdicts().by_source
    kept = sum(row.kept for row in rows)
    told = summary.finding(Findings.of(RunResults(run)))
    assert told.startswith(f"{kept} of 520 demonstrations are kept: {rows[0].kept} of 10 of gravity 15.0, ")
    assert page.text.index(told) < page.text.index("Imitator:")


def test_without_marks_the_cards_show_what_is_known(tmp_path: Path) -> None:
    run = full_run(tmp_path, {"a": None, "b": None}, (6, 4), 2)
    writer = Writer(run, 2)
    writer.clustering(purity=None)
    for stage in ("imitators", "transferability", "imitation"):
        writer.steps()[stage]()
    assert "–" not in cards(run).values()
    assert {"Demonstrations kept", "Clusters"} < set(cards(run)) and "AUROC" not in cards(run)


def test_nothing_tells_where_the_author_keeps_files(tmp_path: Path) -> None:
    run = new_run(tmp_path, SMALL["marks"], SMALL["counts"])
    values = run.config.model_dump(mode="json") | {"baselines": []}
    values["demonstrations"] = {"file": str(tmp_path / "mine.safetensors")}
    page = render(Run(parse_config(values, origin="test"), run.directory))
    assert "mine.safetensors" in page.text and str(tmp_path) not in page.text


def test_where_nothing_can_be_rendered_the_page_says_so(full: tuple[Run, Page]) -> None:
    assert full[1].text.count("No film: cannot render here") == 1


def test_a_failed_write_leaves_the_old_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = new_run(tmp_path, {"a": True}, (3,))
    path = write_report(run)
    before = path.read_bytes()
    Writer(run, 1).demonstrations()

    def full_disk(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", full_disk)
        with pytest.raises(StorageError, match="No space"):
            write_report(run)
    assert path.read_bytes() == before


def test_no_line_names_a_file_or_a_key_of_an_artifact() -> None:
    import oodil.pipeline.report

    code = "".join(path.read_text() for path in Path(oodil.pipeline.report.__file__).parent.glob("*.py"))
    assert not re.search(r"\.(safetensors|json)\b", code)
    assert not re.search(r"\b(imitation|naive_gail|oracle|marks|imitators)\b[\"']", code)


def test_stage_times_are_those_of_the_last_computation(tmp_path: Path) -> None:
    run = new_run(tmp_path, {"a": True}, (3,))
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
    assert RunResults(run).seconds() == {"clustering": 50.0, "transferability": 300.5, "imitation": 70.0}
    assert RunResults(run).seconds_ever() == 20 + 30 + 300 + 0.5 + 90 + 70 + 5


DRIVING: dict[str, Any] = {"id": "oodil/Driving-v0", "dynamics": {"obstacle_1": 0.3, "obstacle_2": 0.2, "speed": 1.0}}


def test_paths_are_drawn_in_the_plane_for_every_weighting(tmp_path: Path, full: tuple[Run, Page]) -> None:
    run = new_run(tmp_path, SMALL["marks"], SMALL["counts"], ("oracle",), environment=DRIVING)
    writer = Writer(run, SMALL["num_clusters"])
    for name in ("demonstrations", "clustering", "imitators", "transferability", "marks"):
        writer.steps()[name]()
    report = contents(run)
    assert [section.title for section in report.paths] == ["ours", "marks"]
    assert "The paths by weight" in render(run).text
    assert paths.world_of(run.config.environment) == layout(0.3, 0.2, 1.0)
    ours, marks = (str(section.figure) for section in report.paths)
    assert "● 3 paths" in ours and "◆ 5 paths" in ours and ours != marks
    assert not contents(full[0]).paths


def test_a_picture_of_paths_follows_the_weights_and_nothing_else() -> None:
    """Equal weights give equal bytes; the shades go from light to dark."""
    world = layout(0.3, 0.2, 1.0)
    across = [Episode(np.array([[-1.0, y, 0, 0, 0], [1.0, -y, 0, 0, 0]])) for y in (-0.5, 0.5)]
    held = Demonstrations.of(across, "a")
    looks = source_looks([None])
    first, second = (paths.paths(held, np.array(weights), looks, world) for weights in ([0.9, 0.1], [0.1, 0.9]))
    assert first == paths.paths(held, np.array([0.9, 0.1]), looks, world) and first != second
    assert paths.SHADES(0.0)[:3] > paths.SHADES(0.5)[:3] > paths.SHADES(1.0)[:3]
    drawn = paths.sheet(held, {"first rule": np.array([0.9, 0.1]), "second rule": np.ones(2)}, world)
    assert "first rule" in drawn and "second rule" in drawn and drawn.count("<image") == 2


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        (formats.spread(368.4, -84.9), "368"),
        (formats.spread(9.94, 1.0), "9.9"),
        (formats.spread(0.0123, 0.5), "0.012"),
        (formats.spread(1234.5, 3000.0), "1,234"),
        (formats.spread(float("nan"), 1.0), formats.UNKNOWN),
        (formats.count(999_499), f"999{formats.SPACE}k"),
        (formats.count(999_500), f"1{formats.SPACE}M"),
        (formats.count(5_322_950), f"5.32{formats.SPACE}M"),
        (formats.count(12), "12"),
        (formats.percent(0.004), f"0.4{formats.SPACE}%"),
        (formats.percent(1.0), f"100{formats.SPACE}%"),
        (formats.duration(59.6), f"1{formats.SPACE}min 00{formats.SPACE}s"),
    ],
)
def test_how_numbers_are_written(written: str, expected: str) -> None:
    assert written == expected
