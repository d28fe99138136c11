"""The page: its sections around the figures."""

from html import escape
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from oodil.pipeline.report import figures, opening, pieces
from oodil.pipeline.report.collection import Collection, Source, read_collection
from oodil.pipeline.report.figures import Curve
from oodil.pipeline.report.style import CSS
from oodil.pipeline.results import STAGES, Results
from oodil.pipeline.stage import Run

QUALITY = (
    ("silhouette", "silhouette", 3),
    ("calinski_harabasz", "Calinski-Harabasz", 1),
    ("label_stability", "label stability", 3),
    ("purity", "purity", 3),
)
"""Key, name and digits of what is said about the clusters."""


def render(run: Run) -> str:
    """Return the HTML of the report for everything that is finished."""
    results = Results(run)
    collection = read_collection(results)
    body = [
        _learning_section(results),
        _transferability_section(results, collection),
        _clustering_section(results, collection),
        _provenance_section(results),
    ]
    head = [opening.headline(results, collection), opening.cards(results), opening.notes(results, collection)]
    title = escape(run.config.name)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{CSS}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join([*head, *body])
        + "\n</main>\n</body>\n</html>\n"
    )


def _learning_section(results: Results) -> str:
    ours, naive = (_curve(results, stage) for stage in ("imitation", "naive_gail"))
    oracle = results.json("oracle", "evaluation.json").get("final_return")
    if ours is None and naive is None:
        return pieces.section("The policy", pieces.missing("No policy has been trained yet."))
    episodes = results.run.config.imitation.gail.evaluation_episodes
    caption = (
        f"True return of the deterministic policy in the imitator's environment, {pieces.plural(episodes, 'episode')} "
        "at each point; the bands are one standard deviation of the episodes. The return is never used for learning. "
    )
    if oracle is not None:
        caption += "Dashed: the final return of the oracle, which imitates only what is known to be transferable."
    return pieces.section(
        "The policy", pieces.figure(figures.learning(ours, naive, oracle), "Learning curves") + pieces.caption(caption)
    )


def _curve(results: Results, stage: str) -> Curve | None:
    found = results.json(stage, "curve.json")
    if not found.get("env_steps"):
        return None
    values = (np.array(found[key], np.float64) for key in ("env_steps", "return_mean", "return_std"))
    return Curve({"imitation": "ours"}.get(stage, pieces.TITLES[stage]), *values)


def _transferability_section(results: Results, collection: Collection | None) -> str:
    arrays = results.arrays("transferability", "transferability.safetensors")
    if collection is None or not arrays:
        return pieces.section(
            "Transferability", pieces.missing("The transferability of the demonstrations is not known yet.")
        )
    summary = results.json("transferability", "summary.json")
    before = collection.transitions.astype(np.float64)
    after = before * arrays["weights"]
    sharpening = summary.get("sharpening")
    parts = [
        pieces.caption(
            "Each mark is one demonstration: how far the discriminator of its cluster's job takes it for something "
            "that the imitator itself does. A demonstration is drawn for imitation in proportion to "
            + ("this value." if sharpening in (None, 1) else f"this value to the power {sharpening:g}.")
        ),
        pieces.legend(collection.sources),
        pieces.figure(
            figures.transferability(arrays["scores"], collection.source_of, collection.looks),
            "Transferability of every demonstration, sorted",
        ),
        "<h3>What the policy learns from</h3>",
        _mass_bars(collection, before, after),
        _source_table(collection, summary.get("mean_score_by_source") or {}, before, after),
        _convergence(results, collection),
    ]
    return pieces.section("Transferability", "\n".join(parts))


def _mass_bars(collection: Collection, before: NDArray[np.float64], after: NDArray[np.float64]) -> str:
    rows = ""
    for title, mass in (("unweighted", before), ("weighted", after)):
        segments = "".join(map(_segment, collection.sources, collection.shares(mass)))
        rows += f'<div>{title}</div><div class="bar">{segments}</div>\n'
    return f'<div class="mass">\n{rows}</div>'


def _segment(source: Source, share: float) -> str:
    style = f"flex:{share:.5f};background:{source.look.color};color:{source.look.text}"
    shown = pieces.percent(share) if share >= 0.05 else ""
    return f'<span style="{style}" title="{escape(source.label)}: {pieces.percent(share)}">{shown}</span>'


def _source_table(
    collection: Collection, mean_scores: dict[str, Any], before: NDArray[np.float64], after: NDArray[np.float64]
) -> str:
    rows = ""
    columns = zip(
        collection.sources, collection.own_returns, collection.shares(before), collection.shares(after), strict=True
    )
    for source, own_return, share_before, share_after in columns:
        known = {True: "yes", False: "no", None: "not known"}[source.transferable]
        cells = (
            str(source.count),
            pieces.returned(own_return) or "–",
            pieces.number(mean_scores.get(source.label), 3) or "–",
            pieces.percent(share_before),
            pieces.percent(share_after),
        )
        numbers = "".join(f'<td class="number">{cell}</td>' for cell in cells)
        rows += f"<tr><th>{pieces.name(source)}</th><td>{known}</td>{numbers}</tr>\n"
    titles = ("demonstrations", "return in its own dynamics", "mean transferability", "share before", "share after")
    head = "<th>source</th><th>transferable</th>" + "".join(f'<th class="number">{title}</th>' for title in titles)
    return pieces.table(head, rows)


def _convergence(results: Results, collection: Collection) -> str:
    history = results.arrays("transferability", "history.safetensors")
    clusters = sorted(int(name.split("/")[0].removeprefix("cluster_")) for name in history if name.endswith("/scores"))
    if not clusters:
        return ""
    histories, colors = {}, {}
    for k in clusters:
        histories[k] = (history[f"cluster_{k}/env_steps"].astype(np.float64), history[f"cluster_{k}/scores"])
        members = collection.source_of[history[f"cluster_{k}/demonstrations"]]
        colors[k] = collection.looks[int(np.bincount(members).argmax())].color
    caption = (
        "Scores while the job of each cluster ran: mean and the range of the middle 80 % of its demonstrations, in the "
        "color of its most frequent source. A curve that still moves at its end asks for a longer job."
    )
    drawn = pieces.figure(figures.convergence(histories, colors), "Scores of each cluster over environment steps")
    return f"<h3>Did the scores settle?</h3>\n{pieces.caption(caption)}\n{drawn}"


def _clustering_section(results: Results, collection: Collection | None) -> str:
    arrays = results.arrays("clustering", "assignment.safetensors")
    if collection is None or not arrays:
        return pieces.section("Clusters", pieces.missing("The demonstrations have not been clustered yet."))
    diagnostics = results.json("clustering", "diagnostics.json")
    projected = figures.project(arrays["features"])
    if projected is None:
        drawn = pieces.missing("There is no embedding to show: the demonstrations were not told apart, or are too few.")
    else:
        points, projection = projected
        drawn = pieces.caption(
            f"The embedding of the demonstrations, brought to two dimensions by {projection}"
            + (", in which only neighborhoods mean something, not distances." if projection == "t-SNE" else ".")
            + " The method sees no sources; they are shown to judge it."
        )
        drawn += pieces.legend(collection.sources)
        svg = figures.embedding(points, arrays["labels"], collection.source_of, collection.looks)
        drawn += pieces.figure(svg, "Embedding of the demonstrations, by cluster and by source")
    named = [
        f"{title} {pieces.number(diagnostics[key], digits)}"
        for key, title, digits in QUALITY
        if diagnostics.get(key) is not None
    ]
    listed = pieces.caption(f"Quality: {', '.join(named)}.") if named else ""
    return pieces.section("Clusters", f"{drawn}\n{_contingency(results, collection, diagnostics)}\n{listed}")


def _contingency(results: Results, collection: Collection, diagnostics: dict[str, Any]) -> str:
    contingency: dict[str, list[int]] = diagnostics.get("contingency") or {}
    if not contingency:
        return ""
    used = [
        k for k in range(len(next(iter(contingency.values())))) if any(counts[k] for counts in contingency.values())
    ]
    rows = ""
    for source in collection.sources:
        if source.label not in contingency:
            continue
        counts = contingency[source.label]
        total = max(sum(counts), 1)
        cells = "".join(_heat(counts[k], counts[k] / total) for k in used)
        rows += f"<tr><th>{pieces.name(source)}</th>{cells}</tr>\n"
    scores = results.arrays("transferability", "transferability.safetensors")
    if scores:
        means = [scores["scores"][scores["clusters"] == k] for k in used]
        cells = "".join(f"<td>{mean.mean():.3f}</td>" if len(mean) else "<td>–</td>" for mean in means)
        rows += f'<tr class="mean"><th>mean transferability</th>{cells}</tr>\n'
    head = "<th>cluster</th>" + "".join(f"<th>{k}</th>" for k in used)
    return "<h3>Which source went into which cluster</h3>\n" + pieces.table(head, rows, "heat")


def _heat(count: int, share: float) -> str:
    color = "#fff" if share > 0.55 else "inherit" if count else "#b9c0ca"
    return f'<td style="background:rgba(47,72,110,{0.05 + 0.85 * share:.3f});color:{color}">{count}</td>'


def _provenance_section(results: Results) -> str:
    run = results.run
    seconds, env_steps = results.seconds(), results.env_steps()
    rows = ""
    for stage in STAGES:
        artifact = results.artifacts.get(stage)
        if artifact is None and stage not in results.problems:
            continue
        time = pieces.duration(seconds[stage]) if stage in seconds else "–"
        steps = f"{env_steps[stage]:,}" if stage in env_steps else "–"
        made = f"<code>{artifact.sha256}</code>" if artifact else escape(results.problems[stage])
        numbers = f'<td class="number">{time}</td><td class="number">{steps}</td>'
        rows += f"<tr><th>{pieces.TITLES[stage]}</th>{numbers}<td>{made}</td></tr>\n"
    head = (
        '<th>stage</th><th class="number">time</th><th class="number">environment steps</th>'
        "<th>SHA-256 of the artifact</th>"
    )
    config = yaml.safe_dump(run.config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    parts = [
        f"<p>Root seed {run.config.seed}; every random stream is derived from it.</p>",
        pieces.table(head, rows),
        _versions(results),
        f"<details><summary>Resolved configuration</summary><pre>{escape(config)}</pre></details>",
    ]
    return pieces.section("What was run", "\n".join(parts))


def _versions(results: Results) -> str:
    """List library versions, and name the stages where one differs from another."""
    found: dict[str, dict[str, list[str]]] = {}
    for stage, artifact in results.artifacts.items():
        for library, version in artifact.versions.items():
            found.setdefault(library, {}).setdefault(version, []).append(pieces.TITLES[stage])
    listed = []
    for library, versions in sorted(found.items()):
        each = [
            version if len(versions) == 1 else f"{version} ({', '.join(used)})" for version, used in versions.items()
        ]
        listed.append(f"{escape(library)} {escape(' and '.join(each))}")
    return f"<p>Made with {', '.join(listed)}.</p>" if listed else ""
