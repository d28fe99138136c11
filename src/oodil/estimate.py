"""What a run will cost: environment steps, which follow from its configuration, and time, from a short measurement."""

import os
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from oodil.pipeline.environments import make_batch
from oodil.pipeline.stage import Run, Stage, state_of

MEASURED_S = 0.3
"""Seconds for which the environment is stepped."""
START_S = 2.0
"""Seconds that a stage takes to load what it computes with, and to write what it has found."""


@dataclass(frozen=True)
class StageCost:
    """What a stage is expected to cost on this machine."""

    env_steps: int
    seconds: float
    jobs: int


@dataclass(frozen=True)
class RunCost:
    """What a run is expected to cost on this machine; stages that are finished cost nothing."""

    stages: dict[str, StageCost]
    """Of all chosen stages, in their order."""
    steps_per_s: float
    """Of the simulator, on one core."""
    workers: int | None
    """Processes that compute at the same time; None if that is not known."""

    def __str__(self) -> str:
        """Say it in a line."""
        steps = sum(cost.env_steps for cost in self.stages.values())
        minutes = sum(cost.seconds for cost in self.stages.values()) / 60
        told = f"to do: {_counted(steps)} environment steps" if steps else "to do: no environment steps"
        if self.workers is not None:
            told += f", about {_minutes(minutes)}" if minutes >= 1 else ", a minute or less"
        return f"{told} ({self.steps_per_s:,.0f} steps/s a core)"


def run_cost(run: Run, chosen: Sequence[Stage], workers: int | None, force: Collection[str] = ()) -> RunCost:
    """Return what the chosen stages of a run will cost; ``workers`` is None for an engine that alone knows it."""
    config = run.config
    environment = config.environment
    step_s = step_seconds(environment.id, environment.dynamics, config.imitation.gail.simulators_per_group)
    costs: dict[str, StageCost] = {}
    for stage in chosen:
        computed = any(costs[name].seconds for name in stage.inputs if name in costs) or stage.name in force
        if not computed and state_of(stage, run).state == "done":
            costs[stage.name] = StageCost(0, 0.0, 1)
            continue
        cost = stage.cost(config, step_s)
        cores = min(max(workers or 1, 1), usable_cores())
        if stage.distributed and cost.jobs < cores:
            seconds = cost.core_s / cores
        else:
            seconds = cost.core_s / cost.jobs * -(-cost.jobs // cores)
        costs[stage.name] = StageCost(cost.env_steps, START_S + seconds, cost.jobs)
    return RunCost(costs, 1 / step_s, workers)


def step_seconds(env_id: str, dynamics: Mapping[str, Any], count: int) -> float:
    """Return how long a step of an environment takes on one core, by so many simulators under random actions."""
    simulators = make_batch(env_id, dynamics, count)
    rng = np.random.default_rng(0)
    for index in range(count):
        simulators.reset(index, seed=index)
    started, steps = time.perf_counter(), 0
    while time.perf_counter() - started < MEASURED_S:
        outcome = simulators.step(rng.uniform(-1, 1, (count, simulators.action_dim)).astype(np.float32))
        steps += count
        for index in np.flatnonzero(outcome.terminated | outcome.truncated).tolist():
            simulators.reset(index, seed=steps + index)
    return (time.perf_counter() - started) / steps


def usable_cores() -> int:
    """Return the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _counted(steps: int) -> str:
    """Return a number of steps in two digits: more would promise too much."""
    if steps >= 1_000_000:
        return f"{steps / 1e6:.2g} million" if steps < 1e8 else f"{steps / 1e6:,.0f} million"
    return f"{float(f'{steps:.2g}'):,.0f}"


def _minutes(minutes: float) -> str:
    if minutes < 90:
        return f"{minutes:.0f} min"
    return f"{minutes / 60:.1f} h" if minutes < 48 * 60 else f"{minutes / 60 / 24:.1f} days"
