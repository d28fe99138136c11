"""The paper's generalization experiment (C.5): demonstrations that come later, for runs of ``oodil table figure4a``.

1. What each weighting of a run that can, frozen, says of the demonstrations of three more frictions.
2. Our policy goes on with all of them, weighed by each of these weightings in turn (Fig. 4 b).

What is fine-tuned lies in ``--folder`` and is resumed; ``--json`` is written after each step and keeps other seeds. Run
``python benchmarks/generalization.py tables/figure4a/*-seed* --folder FOLDER --json FILE``.
"""

import json
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
"""Sources of ``configs/walker2d_generalization.yaml`` that a run has from the beginning; the others come later."""


def later(results: oodil.RunResults) -> Demonstrations:
    """Return the demonstrations of the sources that come later."""
    everything = results.demonstrations
    chosen = everything.select(np.flatnonzero(everything.sources >= KNOWN))
    return replace(chosen, sources=chosen.sources - KNOWN, source_labels=chosen.source_labels[KNOWN:])


def frozen(scored: oodil.Scored, config: RunConfig) -> dict[str, Any]:
    """Return what the frozen weightings say of later demonstrations alone: by source, and against the marks."""
    demonstrations = scored.demonstrations
    by_source = np.array([source.transferable is True for source in config.demonstrations.sources[KNOWN:]])
    marks = by_source[demonstrations.sources]
    return {
        name: separation_metrics(marks, each.scores, each.weights, demonstrations)
        | {"verdicts": VerdictTable.of(each, demonstrations).describe()}
        for name, each in scored.found.items()
    }


def finetuned(results: oodil.RunResults) -> dict[str, Any]:
    """Return what a fine-tuned policy reaches, its learning curve, and on what weights it went on."""
    final, curve = results.evaluation("finetuning"), results.curve("finetuning")
    return results.separation("later_scores") | {
        "mean_return": final.mean_return,
        "std_return": final.std_return,
        "curve": {"env_steps": curve.env_steps.tolist(), "mean_return": curve.mean_return.tolist()},
        "seconds": results.seconds(),
    }


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("run_dirs", type=Path, nargs="+", metavar="RUN_DIR")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--workers", type=int, help="default: as configured")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="overrides of each fine-tuning")
    arguments = parser.parse_args()
    file = arguments.json
    seeds = json.loads(file.read_text())["seeds"] if file and file.exists() else {}
    figures = circumstances() | {"raw_hopper_steps_per_s": raw_rate(), "set": arguments.set, "seeds": seeds}
    for run_dir in arguments.run_dirs:
        base = oodil.open_run(run_dir)
        seed, folder = base.config.seed, arguments.folder / f"seed{base.config.seed}"
        config = load_config("walker2d_generalization", [f"seed={seed}"])
        collected = oodil.run(config, workers=arguments.workers, run_dir=folder / "all", until="demonstrations")
        recorded = folder / "later.safetensors"
        write_file(recorded, encode_demonstrations(later(collected), config.environment.id))
        scored = oodil.score(base, recorded)
        found: dict[str, Any] = {"before": base.evaluation().mean_return, "frozen": frozen(scored, config)}
        titles = {each.name: each.title for each in base.weightings if each.name in scored.found}
        refused = {name: reason.removeprefix(f"{base.path}: ") for name, reason in scored.refused.items()}
        found |= {"titles": titles, "refused": refused, "finetuned": {}}
        seeds[str(seed)] = found
        for name, line in found["frozen"].items():
            print(seed, name, {key: round(line[key], 3) for key in ("auroc", "share_before", "share")}, flush=True)
        save(file, figures)
        marks = ", ".join(source.label for source in config.demonstrations.sources[KNOWN:] if source.transferable)
        for name in scored.found:
            tuned = oodil.finetune(
                base,
                recorded,
                [f"demonstrations.transferable=[{marks}]", *arguments.set],
                weighting=name,
                workers=arguments.workers,
                run_dir=folder / name,
            )
            found["finetuned"][name] = finetuned(tuned)
            print(f"{seed} fine-tuned by {name}: {found['finetuned'][name]['mean_return']:,.0f}", flush=True)
            save(file, figures)


if __name__ == "__main__":
    main()
