"""What several benchmarks need: one thread, where figures come from, a quiet job, the default configuration.

It is imported from beside a script, as ``python benchmarks/NAME.py`` starts it; a script that is started does
everything in a ``main`` behind a guard, because processes that it spawns import it again.
"""

import argparse
import math
import os
import sys
from pathlib import Path
from typing import Any

import torch
from threadpoolctl import threadpool_limits

from oodil.bench import machine
from oodil.pipeline.artifacts import Checkpoints, encode_json
from oodil.pipeline.collecting import InlineRollouts, RolloutSource
from oodil.pipeline.config import EnvironmentConfig, RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.loading import parse_config
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.stages.demonstrations import collect_demonstrations
from oodil.pipeline.versions import library_versions
from oodil.workers.fork_server import ONE_THREAD

OODIL = [sys.executable, "-c", "import sys; from oodil.cli import main; sys.exit(main())"]
"""The command line, as its console script starts it, with the interpreter that is running."""
UNUSED = Checkpoints(Path("unused"), {})
"""Of a `Quiet` job, which writes none."""


def one_thread() -> None:
    """Let this process, and all that start from here, compute with one thread."""
    os.environ.update(ONE_THREAD)
    threadpool_limits(1)
    torch.set_num_threads(1)


def arguments_of(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help is a script's docstring; ``--json FILE`` is for `save`."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    return parser


def seeds_of(text: str) -> range:
    """Return the seeds that ``10-14`` or ``3`` stands for."""
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def circumstances() -> dict[str, Any]:
    """Return what figures depend on; ask before anything is measured, since the load is part of it."""
    return {"machine": machine(), "versions": library_versions()}


def save(path: Path | None, found: dict[str, Any]) -> None:
    """Write `circumstances` and figures to a file, if one was asked for."""
    if path is not None:
        found["machine"]["load_average_after"] = os.getloadavg()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_json(found, sort_keys=False))


def collected(
    expert: GaussianPolicy | None,
    environment: EnvironmentConfig,
    source: int,
    count: int,
    seed: int,
    minimum_return: float | None = None,
) -> Demonstrations:
    """Return demonstrations of a source as configurations collect them: whole episodes, or those of a least return."""
    found, _ = collect_demonstrations(
        expert, environment, source, count, seed,
        deterministic=False, full_length_only=minimum_return is None, minimum_return=minimum_return, context=Quiet(),
    )  # fmt: skip
    return found


class Quiet:
    """The context of a job that reports to nobody, writes no checkpoint and is never stopped."""

    checkpoint_interval_s = math.inf

    def __init__(self, rollouts: RolloutSource | None = None) -> None:
        self.rollouts = rollouts or InlineRollouts()

    def progress(self, done: int, total: int, **metrics: float) -> None:
        """Nobody listens."""

    def warn(self, message: str) -> None:
        """Show it all the same."""
        print(message)

    def should_stop(self) -> bool:
        """Never."""
        return False


def run_config(env_id: str, total_steps: int, **gail: Any) -> RunConfig:
    """Return a configuration that differs from the defaults in ``gail`` alone."""
    gail = {"total_steps": total_steps} | gail
    values = {
        "name": "benchmark",
        "environment": {"id": env_id},
        "demonstrations": {"file": "none"},
        "transferability": {"gail": gail},
        "imitation": {"gail": gail},
    }
    return parse_config(values, "benchmark")
