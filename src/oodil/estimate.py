"""What a run will cost: environment steps, which follow from its configuration, and time, from a short measurement."""

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from oodil.bench import usable_cores
from oodil.experiments import Table
from oodil.orchestrator import read_run
from oodil.pipeline.artifacts import fingerprint
from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.environments import make_batch
from oodil.pipeline.errors import UnusableEnvironmentError
from oodil.pipeline.runs import RunResults
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
    shares: Mapping[str, float] = field(default_factory=dict)
    """By job, its share of the seconds; empty where jobs are alike."""


@dataclass(frozen=True)
class RunCost:
    """What a run is expected to cost on this machine; stages that are finished cost nothing."""

    stages: dict[str, StageCost]
    """Of all chosen stages, in their order."""
    workers: int | None
    """Processes that compute at the same time; None if that is not known."""

    def __str__(self) -> str:
        """Say it in a line."""
        steps = sum(cost.env_steps for cost in self.stages.values())
        minutes = sum(cost.seconds for cost in self.stages.values()) / 60
        told = f"to do: {_counted(steps)} environment steps" if steps else "to do: no environment steps"
        if self.workers is not None:
            told += f", about {_minutes(minutes)}" if minutes >= 1 else ", a minute or less"
        return told


def run_cost(run: Run, chosen: Sequence[Stage], workers: int | None, force: Collection[str] = ()) -> RunCost:
    """Return what the chosen stages of a run will cost; ``workers`` is None for an engine that alone knows it."""
    config = run.config
    step_s = step_seconds(config.environment, config.imitation.gail.simulators_per_group)
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
    return RunCost(costs, workers)


@dataclass(frozen=True)
class Outlook:
    """What is left to do for a run."""

    name: str
    cost: StageCost
    """Of the stages that it computes itself, in one process."""
    finished: list[str]
    """Stages that some run of the table, or of one beside it, has finished."""
    shared: list[str]
    """Stages that a run before it in the list computes."""
    own: list[str]
    """Stages that it computes itself."""


def outlook(table: Table, selected: dict[str, list[Stage]]) -> list[Outlook]:
    """Return what is left to do for the selected runs, in their order."""
    runs = {run.name: run for run in table.runs}
    found = [(RunResults(table.opened(run)), run.parts) for run in table.runs]
    found += [(RunResults(read_run(table.folder.parent / path)), parts) for path, parts in table.beside.items()]
    done = {part for results, parts in found for stage, part in parts.items() if results.is_done(stage)}
    rates: dict[str, float] = {}
    taken: set[str] = set()
    outlooks = []
    for name, stages in selected.items():
        parts, config = runs[name].parts, runs[name].config
        kinds: dict[str, list[Stage]] = {"finished": [], "shared": [], "own": []}
        for stage in stages:
            part = parts[stage.name]
            kinds["finished" if part in done else "shared" if part in taken else "own"].append(stage)
            taken.add(part)
        environment = fingerprint([config.environment.id, config.environment.settings()])
        if environment not in rates:
            rates[environment] = step_seconds(config.environment, config.imitation.gail.simulators_per_group)
        costs = [stage.cost(config, rates[environment]) for stage in kinds["own"]]
        seconds = sum(START_S + cost.core_s for cost in costs)
        cost = StageCost(sum(cost.env_steps for cost in costs), seconds, 1)
        names = {kind: [stage.name for stage in those] for kind, those in kinds.items()}
        outlooks.append(Outlook(name, cost, **names))
    return outlooks


def table_cost(found: Sequence[Outlook], workers: int | None) -> RunCost:
    """Return what the rest of an experiment will cost, as one stage whose jobs are its runs."""
    seconds = {each.name: each.cost.seconds for each in found}
    at_once = max(1, min(workers or 1, usable_cores(), sum(each.cost.env_steps > 0 for each in found)))
    steps, total = sum(each.cost.env_steps for each in found), sum(seconds.values())
    together = max(total / at_once, max(seconds.values(), default=0.0))
    shares = {name: each / total for name, each in seconds.items()} if total else {}
    return RunCost({"table": StageCost(steps, together, len(found), shares)}, workers)


def step_seconds(environment: EnvironmentConfig, count: int = 8) -> float:
    """Return how long a step of an environment takes on one core, by so many simulators under random actions.

    Raises UnusableEnvironmentError for one that does not do what it should.
    """
    try:
        return _measured(environment, count)
    except (RuntimeError, FloatingPointError) as error:
        raise UnusableEnvironmentError(str(error)) from error


def _measured(environment: EnvironmentConfig, count: int) -> float:
    simulators = make_batch(environment.id, environment.dynamics, count)
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


def _counted(steps: int) -> str:
    """Return a number of steps in two digits: more would promise too much."""
    if steps >= 1_000_000:
        return f"{steps / 1e6:.2g} million" if steps < 1e8 else f"{steps / 1e6:,.0f} million"
    return f"{float(f'{steps:.2g}'):,.0f}"


def _minutes(minutes: float) -> str:
    if minutes < 90:
        return f"{minutes:.0f} min"
    return f"{minutes / 60:.1f} h" if minutes < 48 * 60 else f"{minutes / 60 / 24:.1f} days"
