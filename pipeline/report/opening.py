"""The top of the page: what was run, what came out, and what a reader has to know before quoting it."""

from html import escape
from typing import Any

from oodil.pipeline.report import figures, pieces
from oodil.pipeline.report.collection import Collection
from oodil.pipeline.results import Results

FEW_EPISODES = 20
"""Below this a mean return is called rough."""
UNSTABLE_LABELS = 0.9
"""Below this share of labels that survive another draw, clusters are called unstable."""


def headline(results: Results, collection: Collection | None) -> str:
    """Return what was run and what came out, in two sentences."""
    config = results.run.config
    dynamics = ", ".join(f"{name} {value:g}" for name, value in config.environment.dynamics.items())
    imitator = f"<b>{escape(config.environment.id)}</b> with {escape(dynamics or 'its own, unchanged dynamics')}"
    if collection is None:
        lead = f"Imitator: {imitator}."
    else:
        lead = f"Imitator: {imitator}. It learns from {pieces.plural(len(collection.transitions), 'demonstration')}"
        lead += (
            f" of {pieces.plural(len(collection.sources), 'source')}."
            if collection.labelled
            else "; whose is not known."
        )
    finding = _finding(results)
    return (
        f'<header>\n<p class="kicker">Imitation from demonstrators with other dynamics</p>\n'
        f'<h1>{escape(config.name)}</h1>\n<p class="lead">{lead}</p>\n'
        + (
            pieces.legend(collection.sources, counts=True) + _families(collection)
            if collection and collection.labelled
            else ""
        )
        + (f'<p class="finding">{finding}</p>\n' if finding else "")
        + "</header>"
    )


def _families(collection: Collection) -> str:
    """Say what the colors mean."""
    meanings = {True: "Blue: known to be transferable to the imitator.", False: "Orange: known not to be."}
    told = [meaning for known, meaning in meanings.items() if any(s.transferable is known for s in collection.sources)]
    return pieces.caption(" ".join(told)) if told else ""


def _finding(results: Results) -> str:
    ours, naive, oracle = (
        _final(results, stage).get("final_return") for stage in ("imitation", "naive_gail", "oracle")
    )
    if ours is None:
        return ""
    text = f"The policy learned from weighted demonstrations returns <b>{pieces.returned(ours)}</b>"
    if naive is not None:
        # A ratio to next to nothing says nothing.
        comparable = naive > 0 and 0 < ours / naive < 100
        text += f", {ours / naive:.1f} times the" if comparable else ", against"
        text += f" {pieces.returned(naive)} of naive GAIL"
    if oracle is not None:
        text += f"; the oracle, which is told what is transferable, reaches {pieces.returned(oracle)}"
    return text + "."


def _final(results: Results, stage: str) -> dict[str, Any]:
    return results.json(stage, "evaluation.json")


def cards(results: Results) -> str:
    """Return the figures that a reader looks for first."""
    scores = results.json("transferability", "summary.json")
    diagnostics = results.json("clustering", "diagnostics.json")
    seconds, env_steps = results.seconds(), results.env_steps()
    shown = []
    for stage, name in (("imitation", "ours"), ("naive_gail", "naive GAIL"), ("oracle", "oracle")):
        final = _final(results, stage)
        asked = stage in results.artifacts or stage in results.problems
        shown.append(
            _card(
                f"Final return, {name}",
                pieces.returned(final.get("final_return")),
                _spread(final) if asked else "not asked for",
            )
        )
    before, after = scores.get("transferable_share_before"), scores.get("transferable_share")
    share = (
        f'{pieces.percent(before)}<span class="arrow">→</span>{pieces.percent(after)}' if after is not None else None
    )
    shown.append(_card("Transferable share", share, "of what the policy learns from, before and after weighting"))
    shown.append(
        _card(
            "AUROC", pieces.number(scores.get("auroc"), 3), "1 if all transferable demonstrations rank above all others"
        )
    )
    shown.append(_card("Purity of clusters", pieces.number(diagnostics.get("purity"), 3), _cluster_note(diagnostics)))
    shown.append(
        _card("Environment steps", figures.count(sum(env_steps.values())) if env_steps else None, "in all trainings")
    )
    shown.append(_card("Time", pieces.duration(sum(seconds.values())) if seconds else None, "of all finished stages"))
    return f'<dl class="cards">\n{"".join(shown)}</dl>'


def _spread(final: dict[str, Any]) -> str:
    spread, episodes = final.get("final_return_std"), final.get("episodes")
    if spread is None or episodes is None:
        return ""
    digits = f"{spread:,.0f}" if abs(final.get("final_return") or 0) >= 100 else f"{spread:.2g}"
    return f"± {digits} over {pieces.plural(episodes, 'episode')}"


def _cluster_note(diagnostics: dict[str, Any]) -> str:
    if not diagnostics:
        return ""
    return f"{diagnostics.get('non_empty_clusters')} of {diagnostics.get('num_clusters')} clusters in use"


def _card(title: str, figure: str | None, note: str) -> str:
    shown = f'<div class="figure">{figure}</div>' if figure is not None else '<div class="figure unknown">–</div>'
    return f'<div class="card"><dt>{title}</dt><dd>{shown}<div class="note">{note}</div></dd></div>\n'


def notes(results: Results, collection: Collection | None) -> str:
    """Say what limits the figures on this page."""
    stages_with: dict[str, list[str]] = {}
    for stage, problem in results.problems.items():
        stages_with.setdefault(problem, []).append(pieces.TITLES[stage])
    told = [f"<b>Missing: {', '.join(stages)}</b>, {escape(problem)}." for problem, stages in stages_with.items()]
    finals = {stage: _final(results, stage) for stage in ("imitation", "naive_gail", "oracle")}
    trained = {stage: final for stage, final in finals.items() if final}
    if trained:
        seed = results.run.config.seed
        told.append(
            f"One seed ({seed}). Returns of adversarial imitation vary a lot from seed to seed; a comparison needs "
            "five or more. The spreads on this page are between episodes, not between seeds."
        )
    few = {
        pieces.TITLES[stage]: final["episodes"]
        for stage, final in trained.items()
        if final.get("episodes", 99) < FEW_EPISODES
    }
    if few:
        named = ", ".join(f"{title} {number}" for title, number in few.items())
        told.append(f"Few evaluation episodes ({named}): the mean returns are rough.")
    steps = {stage: final.get("env_steps") for stage, final in trained.items()}
    if len(set(steps.values())) > 1:
        named = ", ".join(f"{pieces.TITLES[stage]} {figures.count(value or 0)}" for stage, value in steps.items())
        told.append(f"The final policies were not trained for equally long ({named} environment steps).")
    if collection and any(source.transferable is None for source in collection.sources):
        told.append(
            "It is not known of every source whether it is transferable, so there is no AUROC and no transferable "
            "share to judge the scores by."
        )
    scores = results.json("transferability", "summary.json")
    before, after = scores.get("transferable_share_before"), scores.get("transferable_share")
    if before is not None and after is not None and after <= before:
        told.append(
            "Weighting did not raise the transferable share: the scores do not favor what is transferable. Jobs that "
            "are too short are the usual cause."
        )
    stability = results.json("clustering", "diagnostics.json").get("label_stability")
    if stability is not None and stability < UNSTABLE_LABELS:
        told.append(
            f"Clusters are unstable: only {pieces.percent(stability)} of the demonstrations keep theirs when other "
            "parts of them are drawn."
        )
    if not told:
        return ""
    items = "".join(f"<li>{note}</li>\n" for note in told)
    return f'<aside class="notes">\n<h3>Before you quote these figures</h3>\n<ul>\n{items}</ul>\n</aside>'
