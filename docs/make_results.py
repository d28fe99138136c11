"""Write docs/results.md, its figures and the README's table from the committed results: nothing is typed by hand.

Every experiment is a folder of benchmarks/results/experiments/ with the results.json and made.json that `oodil table`
wrote; a notes.md beside them says why something is as it is. Further sections are from what benchmarks wrote.

Run ``python docs/make_results.py``.
"""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean, median
from typing import Any

from oodil.pipeline.report import formats
from oodil.pipeline.report.table import Table, read_table
from oodil.pipeline.report.table.figures import plots
from oodil.pipeline.report.table.grids import findings
from oodil.pipeline.report.table.summary import Entry
from oodil.pipeline.report.table.texts import lines, markdown, mean, over_seeds

ROOT = Path(__file__).parents[1]
MEASURED = ROOT / "benchmarks" / "results"
EXPERIMENTS = MEASURED / "experiments"
PAGE, FIGURES, README = ROOT / "docs" / "results.md", ROOT / "docs" / "results", ROOT / "README.md"
BEGINNING, END = "\n<!-- results: docs/make_results.py writes this part -->\n", "\n<!-- end of results -->\n"
NAIVE = "naive_gail"

HEAD = """# Results

This page is written by `python docs/make_results.py` from the files of
`benchmarks/results/`. Returns are of the last policy's mean actions. With five seeds
or more there is the interquartile mean (IQM) with its 95 % interval; fewer are listed and have none."""


def tables(folder: Path = EXPERIMENTS) -> dict[str, Table]:
    """Return the tables of all committed experiments by the name of their folders, tables before figures."""
    folders = [path.parent for path in folder.glob("*/results.json")]
    ordered = sorted(folders, key=lambda path: (not path.name.startswith("table"), path.name))
    return {path.name: read_table(path) for path in ordered}


def page(folder: Path = EXPERIMENTS) -> str:
    """Return the whole page in Markdown."""
    held = tables(folder)
    parts = [HEAD, *summary(held)]
    for name, table in held.items():
        pictures = "\n\n".join(f"![{plot.name}: {name}](results/{name}-{plot.name}.svg)" for plot in plots(table))
        notes = folder / name / "notes.md"
        reasons = f"### Why\n\n{notes.read_text(encoding='utf-8').strip()}" if notes.is_file() else ""
        parts.append(markdown(table, level=2, below="\n\n".join(part for part in (pictures, reasons) if part)).strip())
    parts += [alone(), paths(), controls(), choice(), speed()]
    return "\n\n".join(parts) + "\n"


def summary(held: dict[str, Table]) -> Iterator[str]:
    """Yield what the experiments say together: the state of each, and every published figure of ours beside ours."""
    if not held:
        yield "No experiment is committed yet."
        return
    for name, table in held.items():
        said = " ".join(findings(table)) or "Nothing to compare yet."
        done = len(table.records.cells)
        planned = sum(entry.planned for entry in table.entries.values())
        state = "" if done == planned else f" {done} of {formats.plural(planned, 'cell')}."
        yield f"**[{name}](#{anchor(table)})**:{state} {said}"
    better: list[tuple[str, ...]] = []
    worse: list[tuple[str, ...]] = []
    for name, table in held.items():
        for row in table.records.rows:
            entry = table.entries[row, table.ours]
            if entry.found and entry.published is not None:
                shown, difference = table.measure.shown, entry.found.mean - entry.published
                line = (
                    f"{name}, {row}",
                    shown(entry.found.mean),
                    shown(entry.published),
                    f"{'+' if difference >= 0 else '−'}{table.measure.deviation(abs(difference), entry.published)}",
                    ", ".join(shown(value) for value in entry.by_seed.values()),
                )
                (better if table.marked[row, table.ours] == "found" else worse).append(line)
    head = ("experiment, row", "ours", "paper", "difference", "seeds")
    if better:
        yield "## At or above the paper"
        yield lines(head, better)
    if worse:
        yield "## Below the paper"
        yield "Reasons, where they were found, stand with each experiment."
        yield lines(head, worse)


def readme(text: str, folder: Path = EXPERIMENTS) -> str:
    """Return the README with the committed results in it, or as it is while there are none.

    It has those rows of each experiment that have the most seeds, if ours and naive GAIL are among its methods.
    """
    rows = []
    for table in tables(folder).values():
        if not {table.ours, NAIVE} <= set(table.records.methods):
            continue
        where = f"[{table.records.caption.partition(',')[0]}](docs/results.md#{anchor(table)})"
        seeds = {row: len(table.entries[row, table.ours].by_seed) for row in table.records.rows}
        for row in [row for row, count in seeds.items() if count and count == max(seeds.values())]:
            each = [table.entries[row, method] for method in (table.ours, NAIVE)]
            best = table.measure.best(*(entry.found.mean for entry in each if entry.found))
            shares = [table.by_seed(row, table.ours, figure).values() for figure in ("share_before", "share_after")]
            told = " -> ".join(formats.percent(sum(share) / len(share)) for share in shares if share) or formats.UNKNOWN
            rows.append((f"{where}, {row}", str(seeds[row]), *(cell(table, entry, best) for entry in each), told))
    if not rows:
        return text
    head = ("environment and row", "seeds", "ours", "naive GAIL", "share before -> after")
    above, _, rest = text.partition(BEGINNING)
    return f"{above}{BEGINNING}\n{lines(head, rows, escape=False)}\n{END}{rest.partition(END)[2]}"


def cell(table: Table, entry: Entry, best: float) -> str:
    """Return the mean of an entry, in bold if it is the best, and its seeds."""
    shown = mean(table, entry)
    bold = f"**{shown}**" if entry.found and entry.found.mean == best else shown
    return f"{bold} ({over_seeds(table, entry)})"


def anchor(table: Table) -> str:
    """Return where an experiment stands on the page."""
    return table.records.experiment.lower().replace(".", "")


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
        rows.append((
            f"{task}, {_dynamics(seeds[0]['demonstrator'])} → {_dynamics(seeds[0]['imitator'])}",
            f"{seeds[0]['seed']} to {seeds[-1]['seed']}",
            f"{seeds[0]['target']:,.0f}",
            f"{'never' if median(reached) == float('inf') else f'{median(reached) / 1000:,.0f} k'} ({steps})",
            f"{seeds[0]['curve']['env_steps'][-1] / 1e6:.1f} M",
            f"{fmean(returns):,.0f} ({', '.join(f'{each:,.0f}' for each in returns)})",
            ", ".join(formats.percent(seed["final_share"]) for seed in seeds),
        ))  # fmt: skip
    head = ("environment", "seeds", "target", "steps to it: median", "training", "final return: mean", "episodes above")
    return f"""## One source alone

GAIL with the one setting, on demonstrations of one source that the imitator can reproduce; the last column is the
share of 100 final episodes of each seed that are above the target. {_made(file, measured)}

{lines(head, rows, escape=False)}"""


def paths() -> str:
    """Return what every weighting makes of Driving's paths, whose truth is known exactly, and what policies do."""
    measured = json.loads((MEASURED / "driving_weights.json").read_text())
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
    return f"""## Driving's paths

Which paths can be reproduced is known exactly there: those at the imitator's speed that touch none of its obstacles.
The AUROC of that truth and its share of the sampling mass, means over runs, and each run in parentheses; below, the
share of {measured["episodes"]:,} starts from which each policy arrives, by run, and by the third of the start line.
Runs, and how many of their {measured["runs"][0]["paths"]} paths can be reproduced: {runs}.
{_made("driving_weights.json", measured)}

{lines(("weighting", "AUROC", "share before → after"), weightings, escape=False)}

{lines(("policy", "starts that arrive", "left, middle and right third"), policies, escape=False)}

![Paths by source, shaded by what each weighting makes of them, over the imitator's obstacles](driving_weights.svg)

Paths of {measured["runs"][-1]["run"]}: dark is the heaviest of a row, pale has no weight, orange are the imitator's
obstacles and green is the goal. *marks* are those of the configuration, which leave the second source out."""


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


def _dynamics(dynamics: dict[str, float]) -> str:
    return ", ".join(f"{key} {value:g}" for key, value in dynamics.items()) or "as it is"


def _made(file: str, measured: dict[str, Any]) -> str:
    raw = measured.get("raw_hopper_steps_per_s")
    rate = f", raw Hopper `mj_step` {raw:,.0f} a second and core beside other work" if raw else ""
    return f"From [{file}](../benchmarks/results/{file}); {measured['machine']['time'][:10]}{rate}."


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


def figures(folder: Path = EXPERIMENTS) -> dict[str, str]:
    """Return all figures in SVG by the names of their files."""
    return {
        f"{name}-{plot.name}.svg": plot.sheet(table) for name, table in tables(folder).items() for plot in plots(table)
    }


def main() -> None:
    """Write page, README and figures; figures that the page no longer has are removed."""
    PAGE.write_text(page(), encoding="utf-8")
    README.write_text(readme(README.read_text(encoding="utf-8")), encoding="utf-8")
    shutil.rmtree(FIGURES, ignore_errors=True)
    drawn = figures()
    if drawn:
        FIGURES.mkdir()
    for name, svg in drawn.items():
        (FIGURES / name).write_text(svg + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
