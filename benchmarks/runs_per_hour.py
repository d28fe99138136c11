"""Runs per hour of a table, each run inline on a core of its own, against one run after another with workers.

The same configuration and seeds both ways, in turns; beside it what ``oodil table --plan`` expected of the first way.
Run ``python benchmarks/runs_per_hour.py --json FILE`` on a machine that does nothing else.
"""

import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml
from common import OODIL, arguments_of, circumstances, save

from oodil.bench import raw_rate, usable_cores
from oodil.estimate import outlook, table_cost
from oodil.experiments import Table
from oodil.pipeline.experiment import load_experiment


def seconds_of(*arguments: str) -> float:
    """Return the wall time of a command. Raises CalledProcessError when it fails."""
    started = time.perf_counter()
    subprocess.run([*OODIL, *arguments], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - started


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--config", default="quick/driving")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="overrides of every run")
    parser.add_argument("--rounds", type=int, default=1)
    arguments = parser.parse_args()
    cores = usable_cores()
    found: dict[str, Any] = circumstances() | {"raw_hopper_steps_per_s": raw_rate(), "rounds": []}
    found |= {"config": arguments.config, "set": arguments.set, "cores": cores, "runs": cores}
    for _ in range(arguments.rounds):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "experiment.yaml"
            experiment = {
                "name": "rate", "run": arguments.config, "overrides": arguments.set, "rows": {"all": []},
                "methods": ["imitation", "naive_gail"], "seeds": list(range(cores)), "measure": "mean_return",
            }  # fmt: skip
            file.write_text(yaml.safe_dump(experiment))
            table = Table.of(load_experiment(file), Path(folder) / "planned")
            planned = table_cost(outlook(table, table.select(None, None)), cores).stages["table"].seconds
            inline = seconds_of("table", str(file), "--folder", folder, "--workers", str(cores))
            one_by_one = sum(
                seconds_of(
                    "run", arguments.config, f"seed={seed}", "baselines=[naive_gail]", *arguments.set,
                    "--workers", str(cores), "--run-dir", str(Path(folder) / f"run-{seed}"),
                )
                for seed in range(cores)
            )  # fmt: skip
        line = {
            "planned_seconds": planned, "inline_seconds": inline, "with_workers_seconds": one_by_one,
            "inline_runs_per_hour": 3600 * cores / inline, "with_workers_runs_per_hour": 3600 * cores / one_by_one,
        }  # fmt: skip
        found["rounds"].append(line)
        print({name: round(value, 1) for name, value in line.items()}, flush=True)
        save(arguments.json, found)


if __name__ == "__main__":
    main()
