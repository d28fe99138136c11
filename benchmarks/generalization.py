"""The paper's generalization experiment (C.5) for one seed: a run, demonstrations that come later, fine-tuning.

1. Every method, on the first four sources of ``configs/walker2d_generalization.yaml`` (Fig. 4 a).
2. What each weighting that can, frozen, says of the demonstrations of the other three.
3. Our policy goes on with all of them, weighed by each of these weightings in turn (Fig. 4 b).

Runs lie in ``--runs`` and are resumed; ``--json`` is written after each step. Run
``python benchmarks/generalization.py --seed 20 --runs FOLDER --json FILE``.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments_of, circumstances, save

import oodil
from oodil.bench import raw_rate
from oodil.pipeline.artifacts import write_file
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets import encode_demonstrations
from oodil.pipeline.loading import load_config
from oodil.pipeline.runs import separation_metrics
from oodil.pipeline.verdicts import VerdictTable

KNOWN = 4
"""Sources that the run has from the beginning; the others come later."""
METHODS = "naive_gail", "oracle", "f_mdp", "id_random", "id_gail", "exact_id"
"""Policies beside ours; those whose weighting can score other demonstrations are in the later steps, too."""


def values_of(config: RunConfig, num_sources: int) -> dict[str, Any]:
    """Return a configuration with its first sources alone, and every method beside ours."""
    values = config.model_dump(mode="json") | {"baselines": list(METHODS)}
    values["demonstrations"]["sources"] = values["demonstrations"]["sources"][:num_sources]
    return values


def later(results: oodil.RunResults) -> Demonstrations:
    """Return the demonstrations of the sources that come later."""
    everything = results.demonstrations
    chosen = everything.select(np.flatnonzero(everything.sources >= KNOWN))
    return replace(chosen, sources=chosen.sources - KNOWN, source_labels=chosen.source_labels[KNOWN:])


def policy_line(results: oodil.RunResults, name: str) -> dict[str, Any]:
    """Return what a policy reaches, and its learning curve."""
    final, curve = results.evaluation(name), results.curve(name)
    return {
        "mean_return": final.mean_return,
        "std_return": final.std_return,
        "mean_length": final.mean_length,
        "env_steps": results.policy(name).env_steps,
        "curve": {"env_steps": curve.env_steps.tolist(), "mean_return": curve.mean_return.tolist()},
    }


def base_figures(results: oodil.RunResults) -> dict[str, Any]:
    """Return what every method has found on the first sources, and what it took."""
    return {
        "policies": {each.name: policy_line(results, each.name) for each in results.policies},
        "weightings": {each.name: results.separation(each.name) for each in results.weightings},
        "purity": results.cluster_diagnostics.purity,
        "env_steps": results.env_steps(),
        "seconds": results.seconds(),
    }


def later_figures(scored: oodil.Scored, config: RunConfig) -> dict[str, Any]:
    """Return what the frozen weightings say of later demonstrations alone: by source, and against the marks."""
    demonstrations = scored.demonstrations
    by_source = np.array([source.transferable is True for source in config.demonstrations.sources[KNOWN:]])
    marks = by_source[demonstrations.sources]
    found = {
        name: separation_metrics(marks, each.scores, each.weights, demonstrations)
        | {"verdicts": VerdictTable.of(each, demonstrations).describe()}
        for name, each in scored.found.items()
    }
    return {"weightings": found, "refused": scored.refused}


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--runs", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--workers", type=int, help="default: as configured")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="overrides of every run")
    arguments = parser.parse_args()
    folder, workers = arguments.runs / f"seed{arguments.seed}", arguments.workers
    figures = circumstances() | {"raw_hopper_steps_per_s": raw_rate(), "seed": arguments.seed, "set": arguments.set}
    config = load_config("walker2d_generalization", [f"seed={arguments.seed}", *arguments.set])
    sources = config.demonstrations.sources

    base = oodil.run(values_of(config, KNOWN), workers=workers, run_dir=folder / "base")
    figures["base"] = base_figures(base)
    print({name: round(line["mean_return"]) for name, line in figures["base"]["policies"].items()}, flush=True)
    save(arguments.json, figures)

    collected = oodil.run(
        values_of(config, len(sources)), workers=workers, run_dir=folder / "all", until="demonstrations"
    )
    file = folder / "later.safetensors"
    write_file(file, encode_demonstrations(later(collected), config.environment.id))
    scored = oodil.score(base, file)
    figures["later"] = later_figures(scored, config)
    for name, line in figures["later"]["weightings"].items():
        print(name, {key: round(line[key], 3) for key in ("auroc", "share_before", "share")}, flush=True)
    save(arguments.json, figures)

    marks = ", ".join(source.label for source in sources[KNOWN:] if source.transferable)
    figures["finetuned"] = {}
    for name in scored.found:
        tuned = oodil.finetune(
            base,
            file,
            [f"demonstrations.transferable=[{marks}]"],
            weighting=name,
            workers=workers,
            run_dir=folder / f"finetuned-{name}",
        )
        line = policy_line(tuned, "finetuning") | tuned.separation("later_scores") | {"seconds": tuned.seconds()}
        figures["finetuned"][name] = line
        print(f"fine-tuned by {name}:", round(line["mean_return"]), flush=True)
        save(arguments.json, figures)


if __name__ == "__main__":
    main()
