"""What the check ``reproducibility`` says of Hopper, Walker2d and HalfCheetah, and how long it takes on one core.

Demonstrations of the sources of three configurations are followed by the simulator of each one's imitator. By source:
mean, median and the distances that three of four and nine of ten trials keep, after one step and after several; how
large a part of the states does not tell where a simulator is, because a velocity was clipped. By environment: AUROC of
the demonstrations' mean distances against the marks.

Run ``python benchmarks/reproducibility.py --json FILE``.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from common import Quiet, arguments_of, circumstances, collected, one_thread, save
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

from oodil.pipeline.config import EnvironmentConfig, ReproducibilityConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.loading import load_config
from oodil.pipeline.results import Reproducibility
from oodil.pipeline.stages.experts import load_expert
from oodil.pipeline.stages.reproducibility import follow

CONFIGS = Path(__file__).parents[1] / "configs"


def measure(name: str, count: int, section: ReproducibilityConfig) -> dict[str, Any]:
    config = load_config(CONFIGS / f"{name}.yaml")
    environment, sources = config.environment, config.demonstrations.sources
    parts = []
    for i, source in enumerate(sources):
        assert source.expert_folder is not None
        demonstrator = EnvironmentConfig(id=environment.id, dynamics=source.dynamics)
        parts.append(collected(load_expert(source.expert_folder)[0], demonstrator, i, count, config.seed))
    demonstrations = Demonstrations.joined(parts)
    begun, begun_cpu = time.perf_counter(), time.process_time()
    found = follow(demonstrations, range(len(demonstrations)), environment, section, config.seed, Quiet())
    seconds, cpu = time.perf_counter() - begun, time.process_time() - begun_cpu
    told = make_batch(environment.id, environment.dynamics, 1).tells_state(demonstrations.observations)
    states_of = np.repeat(demonstrations.sources, demonstrations.lengths)
    marks = np.array([source.transferable is True for source in sources])[demonstrations.sources]
    reproducible = found.reproducible_sources(demonstrations)
    rows = []
    for i, source in enumerate(sources):
        mine = demonstrations.sources == i
        row = {
            "source": source.label,
            "transferable": source.transferable,
            "reproducible": reproducible[i],
            "clipped_states": round(float(1 - told[states_of == i].mean()), 3),
            "one_step": described(found.one_step[mine]),
            "horizon": described(found.horizon[mine]),
        }
        print(row, flush=True)
        rows.append(row)
    figures = {
        "environment": environment.id,
        "imitator": environment.dynamics,
        "demonstrations": len(demonstrations),
        "auroc_one_step": round(float(roc_auc_score(marks, -found.mean())), 3),
        "auroc_horizon": round(float(roc_auc_score(marks, -found.horizon_mean())), 3),
        "env_steps": found.env_steps,
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu, 1),
    }
    print(figures, flush=True)
    return figures | {"sources": rows}


def described(distances: NDArray[np.float64]) -> dict[str, float]:
    known = distances[np.isfinite(distances)]
    kept = {f"p{round(100 * share)}": np.quantile(known, share) for share in (Reproducibility.SHARE, 0.9)}
    named = {"mean": known.mean(), "median": np.median(known)} | kept
    return {name: round(float(value), 4) for name, value in named.items()}


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("--configs", nargs="+", default=["quickstart", "walker2d", "half_cheetah"])
    parser.add_argument("--count", type=int, default=10, help="demonstrations of each source")
    arguments = parser.parse_args()
    section = ReproducibilityConfig()
    found = circumstances() | {"section": section.model_dump()}
    found["environments"] = [measure(name, arguments.count, section) for name in arguments.configs]
    save(arguments.json, found)


if __name__ == "__main__":
    main()
