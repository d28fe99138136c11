"""Controls of the score on Hopper: demonstrations of which the answer is known before.

One run whose sources are the imitator's own dynamics (gravity 12), gravity 9.8, the same demonstrations played
backwards, and gravities 2.0 and 1.0; then the frozen models of that run score fresh demonstrations: of some of these
dynamics, and of gravity 9.8 changed in several ways. Each of these must get a low score or be called unlike, but for
those that start a metre ahead, which are as good as genuine ones.

Run ``python benchmarks/controls.py --seed 10 --runs FOLDER --json FILE``.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments_of, circumstances, collected, one_thread, save
from gail_reference import EXPERTS
from numpy.typing import NDArray

import oodil
from oodil.bench import raw_rate
from oodil.pipeline.artifacts import write_file
from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import encode_demonstrations
from oodil.pipeline.stages.experts import load_expert

OWN, GENUINE = "gravity 12.0 (own)", "gravity 9.8"
SOURCES = {OWN: (12.0, 10), GENUINE: (9.8, 10), "gravity 2.0": (2.0, 50), "gravity 1.0": (1.0, 50)}
FRESH = 6
"""Demonstrations of each kind for the frozen models."""
States = NDArray[np.float32]


def changes(rng: np.random.Generator) -> dict[str, Callable[[States], States]]:
    """Return ways to change (T, S) states, by name; the first two dimensions are place and height."""
    return {
        "reversed": lambda states: states[::-1],
        "shuffled in time": lambda states: rng.permutation(states),
        "every second state": lambda states: states[::2],
        "one metre ahead": lambda states: states + np.eye(states.shape[1], dtype=np.float32)[0],
        "one metre higher": lambda states: states + np.eye(states.shape[1], dtype=np.float32)[1],
        "noise of 0.3": lambda states: states + 0.3 * rng.standard_normal(states.shape, dtype=np.float32),
        "noise of 0.01": lambda states: states + 0.01 * rng.standard_normal(states.shape, dtype=np.float32),
        "standing still": lambda states: np.repeat(states[:1], len(states), axis=0),
    }


def demonstrations_of(label: str, count: int, seed: int) -> Demonstrations:
    """Return demonstrations of one of the sources."""
    gravity, _ = SOURCES[label]
    expert, _ = load_expert(EXPERTS / f"hopper-gravity-{gravity}")
    return collected(expert, EnvironmentConfig(id="oodil/Hopper-v0", dynamics={"gravity": gravity}), 0, count, seed)


def changed(shown: Demonstrations, label: str, change: Callable[[States], States]) -> Demonstrations:
    """Return demonstrations with other states."""
    return Demonstrations.of([Episode(np.ascontiguousarray(change(shown[n]))) for n in range(len(shown))], label)


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("--seed", type=int, default=10)
    parser.add_argument("--runs", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="overrides of the run")
    arguments = parser.parse_args()
    seed = arguments.seed
    found: dict[str, Any] = circumstances() | {"raw_hopper_steps_per_s": raw_rate(), "seed": seed, "set": arguments.set}
    parts = {label: demonstrations_of(label, count, seed) for label, (_, count) in SOURCES.items()}
    parts["reversed"] = changed(parts[GENUINE], "reversed", lambda states: states[::-1])
    folder = arguments.runs / f"controls-seed{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "demonstrations.safetensors"
    named = [
        part if label == "reversed" else changed(part, label, lambda states: states) for label, part in parts.items()
    ]
    write_file(file, encode_demonstrations(Demonstrations.joined(named), "oodil/Hopper-v0"))
    overrides = [
        f"seed={seed}", "demonstrations.sources=[]", f"demonstrations.file={file}", "baselines=[]",
        "clustering.num_clusters=6", *arguments.set,
    ]  # fmt: skip
    run = oodil.run("hopper", overrides, run_dir=folder / "run", until="transferability")
    scores, sources = run.transferability.scores, run.demonstrations.sources
    found["sources"] = {}
    for source, label in enumerate(parts):
        those = scores[sources == source]
        verdicts = run.transferability.verdicts[sources == source]
        found["sources"][label] = {
            "scores": those.round(4).tolist(), "kept": int((verdicts == "kept").sum()), "mean": float(those.mean()),
        }  # fmt: skip
        print(f"{label}: mean {those.mean():.3f}, {those.min():.3f} to {those.max():.3f}", flush=True)

    rng = np.random.default_rng(seed)
    later = {label: demonstrations_of(label, FRESH, seed + 1_000) for label in SOURCES}
    later |= {label: changed(later[GENUINE], label, change) for label, change in changes(rng).items()}
    found["fresh"] = {}
    for label, part in later.items():
        scored = oodil.score(run, part, "transferability").found["transferability"]
        verdicts = scored.verdicts.tolist()
        told = {verdict: verdicts.count(verdict) for verdict in sorted(set(verdicts))}
        given = [None if np.isnan(score) else round(float(score), 4) for score in scored.scores]
        found["fresh"][label] = {"scores": given, "verdicts": told}
        print(f"fresh, {label}: {np.round(scored.scores, 3).tolist()}, {told}", flush=True)
    save(arguments.json, found)


if __name__ == "__main__":
    main()
