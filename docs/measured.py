"""The sections of docs/results.md that are made from what benchmarks wrote, each by one function."""

import json
from pathlib import Path
from statistics import fmean, median
from typing import Any

from matplotlib.ticker import FuncFormatter

from oodil.pipeline.report import formats
from oodil.pipeline.report.canvas import drawing, steps_axis, tick
from oodil.pipeline.report.looks import INK, MUTED, POLICIES
from oodil.pipeline.report.table.texts import lines

MEASURED = Path(__file__).parents[1] / "benchmarks" / "results"
EXPERIMENTS = MEASURED / "experiments"
"""A folder for each table that was kept."""


def alone() -> str:
    """Return what GAIL makes of one reproducible source in every environment."""
    file = "gail_reference_reported.json"
    measured = json.loads((MEASURED / file).read_text())
    rows = []
    for task in dict.fromkeys(seed["task"] for seed in measured["seeds"]):
        seeds = [seed for seed in measured["seeds"] if seed["task"] == task]
        reached = [seed["steps_to_target"] or float("inf") for seed in seeds]
        steps = ", ".join("never" if each == float("inf") else f"{each / 1000:,.0f} k" for each in reached)
        returns = [seed["final_return"] for seed in seeds]
        # Made before a training had candidates.
        end = "" if "kept_after" in seeds[0] else "; the end"
        rows.append((
            f"{task}, {_dynamics(seeds[0]['demonstrator'])} → {_dynamics(seeds[0]['imitator'])}{end}",
            f"{seeds[0]['seed']} to {seeds[-1]['seed']}",
            f"{seeds[0]['target']:,.0f}",
            f"{'never' if median(reached) == float('inf') else f'{median(reached) / 1000:,.0f} k'} ({steps})",
            f"{seeds[0]['curve']['env_steps'][-1] / 1e6:.1f} M",
            f"{fmean(returns):,.0f} ({', '.join(f'{each:,.0f}' for each in returns)})",
            ", ".join(formats.percent(seed["final_share"]) for seed in seeds),
        ))  # fmt: skip
    head = ("environment", "seeds", "target", "steps to it: median", "training", "final return: mean", "episodes above")
    return f"""## One source alone

GAIL with the one setting, on demonstrations of one source that the imitator can reproduce: what a run would keep of
one training, or its end where that is said. The last column is the share of 100 episodes of each seed that are above
the target. {_made(file, measured)}

{lines(head, rows, escape=False)}"""


def paths() -> str:
    """Return what every weighting makes of Driving's paths, whose truth is known exactly, and what policies do."""
    return f"""## Driving's paths

Which paths can be reproduced is known exactly there: those at the imitator's speed that touch none of its obstacles.
The AUROC of that truth and its share of the sampling mass, means over runs, and each run in parentheses; below, the
share of starts from which each policy arrives, by run, and by the third of the start line.

{_paths_of("driving_weights.json")}

By the code before [failed episodes](measurements.md#failed-episodes) were read until the time limit:

{_paths_of("driving_weights_before.json")}

![Paths by source, shaded by what each weighting makes of them, over the imitator's obstacles](driving_weights.svg)

Paths of the last of these runs: dark is the heaviest of a row, pale has no weight, orange are the imitator's
obstacles and green is the goal. *marks* are those of the configuration, which leave the second source out."""


def _paths_of(file: str) -> str:
    """Return what one file has of Driving's paths."""
    measured = json.loads((MEASURED / file).read_text())
    weightings, policies = [], []
    for name in dict.fromkeys(name for run in measured["runs"] for name in run["weightings"]):
        each = [run["weightings"][name] for run in measured["runs"] if name in run["weightings"]]
        shares = (formats.percent(fmean(one[key] for one in each)) for key in ("share_before", "share"))
        aurocs = ", ".join(f"{one['auroc']:.3f}" for one in each)
        weightings.append((name, f"{fmean(one['auroc'] for one in each):.3f} ({aurocs})", " → ".join(shares)))
    for name in dict.fromkeys(name for run in measured["runs"] for name in run["policies"]):
        each = [run["policies"][name] for run in measured["runs"] if name in run["policies"]]
        reached = [formats.percent(one["share_reached"]) for one in each]
        thirds = (formats.percent(fmean(one["by_third"][i] for one in each)) for i in range(3))
        policies.append((name, ", ".join(reached), ", ".join(thirds)))
    runs = ", ".join(f"{run['run']} ({run['reproducible']})" for run in measured["runs"])
    return f"""Runs, and how many of their {measured["runs"][0]["paths"]} paths can be reproduced: {runs};
{measured["episodes"]:,} starts. {_made(file, measured)}

{lines(("weighting", "AUROC", "share before → after"), weightings, escape=False)}

{lines(("policy", "starts that arrive", "left, middle and right third"), policies, escape=False)}"""


def later() -> str:
    """Return what is made of demonstrations that come after a run: by its frozen weightings, and by fine-tuning."""
    file = "generalization.json"
    measured = json.loads((MEASURED / file).read_text())
    runs = measured["seeds"].values()
    weightings, sources = [], []
    for name, title in _titles(measured).items():
        frozen = [run["frozen"][name] for run in runs if name in run["frozen"]]
        # Without a score all weigh the same, which says nothing.
        frozen = [run for run in frozen if any(each["unlike"] < each["demonstrations"] for each in _by_source(run))]
        tuned = [run["finetuned"][name]["mean_return"] for run in runs if name in run["finetuned"]]
        told = ("all unlike", formats.UNKNOWN)
        if frozen:
            shares = (formats.percent(fmean(each[key] for each in frozen)) for key in ("share_before", "share"))
            told = (f"{fmean(each['auroc'] for each in frozen):.3f}", " → ".join(shares))
        reached = f"{fmean(tuned):,.0f} ({', '.join(f'{each:,.0f}' for each in tuned)})" if tuned else formats.UNKNOWN
        weightings.append((title, *told, reached))
    for seed, run in measured["seeds"].items():
        for each in _by_source(run["frozen"]["transferability"]):
            verdicts = (str(each[key]) for key in ("demonstrations", "kept", "open", "unlike"))
            score = (
                f"{each['score']:.3f} [{each['low']:.3f}, {each['high']:.3f}]"
                if each["score"] is not None
                else formats.UNKNOWN
            )
            sources.append((seed, each["name"], *verdicts, score))
    before = ", ".join(f"{run['before']:,.0f}" for run in runs)
    head = ("weighting", "AUROC", "share before → after", "fine-tuned: mean return (seeds)")
    return f"""## Demonstrations that come later

Walker2d, as the paper's C.5: runs of [figure4a](#figure4a), then 10, 50 and 50 demonstrations of frictions 24.9, 0.7
and 0.1, of which the first can be reproduced. Their scores by what each weighting of the run had learned, frozen;
then our policy, of {before} before, goes on with all of them, weighed by each in turn. Seeds
{", ".join(measured["seeds"])}. {_made(file, measured)}

{lines(head, weightings, escape=False)}

What ours says of the later ones:

{lines(("seed", "source", "demonstrations", "kept", "open", "unlike", "score and interval"), sources, escape=False)}

![Learning curves of our policy on all demonstrations, by weighting](results/later-curves.svg)"""


def later_curves() -> str:
    """Return how our policy goes on by each weighting, a line for each seed, as an SVG image."""
    measured = json.loads((MEASURED / "generalization.json").read_text())
    with drawing("later-curves", 6.4, 3.2) as (figure, svg):
        figure.set_facecolor("white")
        axes = figure.subplots()
        for (name, title), color in zip(_titles(measured).items(), POLICIES, strict=False):
            label = title
            for run in measured["seeds"].values():
                if name in run["finetuned"]:
                    curve = run["finetuned"][name]["curve"]
                    width = 2.2 if color == INK else 1.5
                    axes.plot(curve["env_steps"], curve["mean_return"], color=color, linewidth=width, label=label)
                    label = "_another seed"
        for run in measured["seeds"].values():
            axes.axhline(run["before"], color=MUTED, linestyle="dotted", linewidth=1)
        axes.set(xlabel="environment steps of the fine-tuning", ylabel="return")
        axes.set_xlim(left=0)
        steps_axis(axes, 5)
        axes.yaxis.set_major_formatter(FuncFormatter(tick))
        figure.legend(loc="outside right upper", frameon=False)
    return svg.getvalue()


def controls() -> str:
    """Return the scores of demonstrations of which the answer is known before."""
    measured = json.loads((MEASURED / "controls.json").read_text())
    rows = [
        (f"in the run: {label}", f"{min(each['scores']):.3f} to {max(each['scores']):.3f}",
         f"{each['kept']} of {len(each['scores'])} kept")
        for label, each in measured["sources"].items()
    ]  # fmt: skip
    for label, each in measured["fresh"].items():
        scores = [score for score in each["scores"] if score is not None]
        told = ", ".join(f"{count} {verdict}" for verdict, count in each["verdicts"].items())
        rows.append((label, f"{min(scores):.3f} to {max(scores):.3f}" if scores else formats.UNKNOWN, told))
    return f"""## Controls of the score

An imitator under gravity 12, seed {measured["seed"]}: sources of one run, and below them fresh demonstrations that
its frozen models score. Whatever is changed is of gravity 9.8; reversed ones are played backwards.
{_made("controls.json", measured)}

{lines(("demonstrations", "scores", "verdicts"), rows, escape=False)}"""


def choice() -> str:
    """Return whether the distance to the demonstrations chooses well among trainings."""
    measured = json.loads((MEASURED / "selection.json").read_text())
    rows = [
        (f"{experiment}, {method}", str(each["policies"]), f"{each['rank_correlation']:.2f}",
         *(f"{each[key]:,.0f}" for key in ("mean_return", "kept", "best")),
         f"{each['kept_is_best']} of {len(each['runs'])}")
        for experiment, methods in measured["experiments"].items()
        for method, each in methods.items()
    ]  # fmt: skip
    head = ("experiment, method", "policies", "rank correlation", "all", "kept", "best of each run", "kept is best")
    return f"""## The choice among trainings

Of several trainings the one is kept whose mean actions come closest to the weighted demonstrations; returns play no
part. The correlation is between that distance and the return over all policies, so -1 would be perfect; then mean
returns of all policies, of those kept, and of the best of each run. {_made("selection.json", measured)}

{lines(head, rows, escape=False)}"""


def speed() -> str:
    """Return how fast one core of the machine is that measured throughput."""
    throughput = json.loads((MEASURED / "throughput.json").read_text())
    batched = json.loads((MEASURED / "environments.json").read_text())["environments"]
    names = list(batched)
    raw = {name.removeprefix("oodil/").removesuffix("-v0"): each for name, each in throughput["stepping"].items()}
    rows = [
        ("raw `mj_step`", *(f"{raw[name]['raw_steps_per_s']:,.0f}" if name in raw else "–" for name in names)),
        ("batched", *(f"{each['batched_steps_per_s']:,.0f}" for each in batched.values())),
    ]
    machine, versions = throughput["machine"], throughput["versions"]
    made = f"{machine['cores']} cores of {machine['cpu']}, " + ", ".join(f"{k} {v}" for k, v in versions.items())
    sources = "[throughput.json](../benchmarks/results/throughput.json), "
    sources += "[environments.json](../benchmarks/results/environments.json)"
    title = f"## Speed of one core\n\nSteps per second: {sources}; {made}."
    return f"{title}\n\n{lines(('', *names), rows, escape=False)}"


def _dynamics(dynamics: dict[str, float]) -> str:
    return ", ".join(f"{key} {value:g}" for key, value in dynamics.items()) or "as it is"


def _made(file: str, measured: dict[str, Any]) -> str:
    raw = measured.get("raw_hopper_steps_per_s")
    rate = f", raw Hopper `mj_step` {raw:,.0f} a second and core beside other work" if raw else ""
    return f"From [{file}](../benchmarks/results/{file}); {measured['machine']['time'][:10]}{rate}."


def _by_source(frozen: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the verdicts of a frozen weighting, a line for each source."""
    found: list[dict[str, Any]] = frozen["verdicts"]["by_source"]
    return found


def _titles(measured: dict[str, Any]) -> dict[str, str]:
    """Return what each weighting of any seed is called, by name."""
    return {name: title for run in measured["seeds"].values() for name, title in run["titles"].items()}
