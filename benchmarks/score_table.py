"""What the method finds and what its policies reach, over seeds: one line a run, and a table in Markdown.

Runs lie in ``--runs``, one folder each, and are resumed; ``--json`` is written after each run.

Run ``python benchmarks/score_table.py hopper driving --seeds 10-14 --runs FOLDER --json FILE``.
"""

from pathlib import Path
from typing import Any

import numpy as np
from common import arguments_of, circumstances, save, seeds_of

import oodil
from oodil.bench import raw_rate
from oodil.pipeline.results import Trainings

WORST = "auroc", "share", "effective_number"
"""Shown for the worst seed."""


def line_of(results: oodil.RunResults) -> dict[str, Any]:
    """Return the figures of a finished run."""
    found, marks = results.transferability, results.marks()
    solved = results.config.demonstrations.minimum_return or 0.0
    policies = {}
    for policy in results.policies:
        trainings = Trainings.load(results.artifact(policy.name)).trainings
        final = results.evaluation(policy.name)
        policies[policy.name] = {
            "mean_return": final.mean_return,
            "solved": float((final.returns >= solved).mean()),
            "trainings": [vars(training) for training in trainings],
        }
    sources = results.demonstrations.sources
    return {
        "config": results.config.name,
        "seed": results.config.seed,
        "demonstrations": len(sources),
        "transferable": int(marks.sum()) if marks is not None else None,
        **results.separation(),
        "score_by_source": [float(found.scores[sources == s].mean()) for s in np.unique(sources)],
        "kept": {verdict: int((found.verdicts == verdict).sum()) for verdict in ("kept", "open", "not kept")},
        "policies": policies,
        "env_steps": results.env_steps(),
        "seconds": results.seconds(),
        "purity": results.cluster_diagnostics.purity,
    }


def table_of(lines: list[dict[str, Any]]) -> str:
    """Return a Markdown table: what was found in the worst seed of each configuration, and returns."""
    rows = [
        "| run | seeds | AUROC | share | effective number | ours, mean (worst) | naive GAIL, mean (worst) |",
        "|---" * 7 + "|",
    ]
    for name in dict.fromkeys(line["config"] for line in lines):
        mine = [line for line in lines if line["config"] == name]
        auroc, share, number = (min(line.get(key, np.nan) for line in mine) for key in WORST)
        cells = [name, ", ".join(str(line["seed"]) for line in mine), f"{auroc:.3f}", f"{share:.1%}"]
        cells.append(f"{number:.1f} of {mine[0]['transferable']}")
        for policy in ("imitation", "naive_gail"):
            returns = [line["policies"][policy]["mean_return"] for line in mine if policy in line["policies"]]
            cells.append(f"{np.mean(returns):,.0f} ({min(returns):,.0f})" if returns else "")
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("configs", nargs="+", metavar="CONFIG")
    parser.add_argument("--seeds", type=seeds_of, default=range(5), metavar="A-B")
    parser.add_argument("--runs", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="overrides of every run")
    arguments = parser.parse_args()
    found = circumstances() | {"raw_hopper_steps_per_s": raw_rate(), "set": arguments.set}
    lines: list[dict[str, Any]] = []
    for seed in arguments.seeds:
        for config in arguments.configs:
            name = "-".join([config, *arguments.set, f"seed{seed}"]).replace("/", "-").replace("=", "")
            run = oodil.run(config, [f"seed={seed}", *arguments.set], run_dir=arguments.runs / name)
            lines.append(line_of(run))
            returns = {policy: round(each["mean_return"]) for policy, each in lines[-1]["policies"].items()}
            print({key: lines[-1].get(key) for key in ("config", "seed", *WORST)}, returns, flush=True)
            save(arguments.json, found | {"runs": lines})
    print(table_of(lines))


if __name__ == "__main__":
    main()
