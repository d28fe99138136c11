"""What a run will cost: environment steps, which follow from its configuration, and time, from a short measurement."""

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from oodil.bench import usable_cores
from oodil.experiments import Table
from oodil.orchestrator import read_run
from oodil.pipeline.artifacts import fingerprint
from oodil.pipeline.config import RunConfig
from oodil.pipeline.environments import Simulators, make_batch
from oodil.pipeline.errors import UnusableEnvironmentError
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import Run, Stage, state_of
from oodil.pipeline.stages import stages as stages_of

MEASURED_S = 0.3
"""Seconds for which the environment is stepped."""
START_S = 2.0
"""Seconds that a stage takes to load what it computes with, and to write what it has found."""
REFERENCE_STEPS_PER_S = 15_000
"""Of Hopper on one core of the machine that the constants of `oodil.pipeline.stage.Cost` are from."""


@dataclass(frozen=True)
class StageCost:
    """What a stage is expected to cost on this machine."""

    env_steps: int
    seconds: float
    jobs: int
    shares: Mapping[str, float] = field(default_factory=dict)
    """By job, its share of the seconds; empty where jobs are alike."""


@dataclass(frozen=True)
class Pace:
    """How fast one core of this machine is."""

    step_s: float
    """Seconds for a step of the environment."""
    max_episode_steps: int
    slowness: float
    """Times that it takes for what the reference machine computes in one second."""

    def cost(self, stage: Stage, config: RunConfig) -> StageCost:
        """Return what all jobs of a stage are expected to cost on one core, without its start."""
        cost = stage.cost(config)
        env_steps = cost.env_steps + cost.episodes * self.max_episode_steps
        all_steps = env_steps + cost.other_episodes * self.max_episode_steps
        return StageCost(env_steps, all_steps * self.step_s + cost.compute_s * self.slowness, cost.jobs)


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
    config, pace = run.config, pace_of(run.config)
    costs: dict[str, StageCost] = {}
    for stage in chosen:
        computed = any(costs[name].seconds for name in stage.inputs if name in costs) or stage.name in force
        if not computed and state_of(stage, run).state == "done":
            costs[stage.name] = StageCost(0, 0.0, 1)
            continue
        cost = pace.cost(stage, config)
        cores = min(max(workers or 1, 1), usable_cores())
        if stage.distributed and cost.jobs < cores:
            seconds = cost.seconds / cores
        else:
            seconds = cost.seconds / cost.jobs * -(-cost.jobs // cores)
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
    # Two stages that do the same may have different numbers of jobs, such as trainings: the more there are the better.
    done: dict[str, int] = {}
    for results, parts in found:
        for stage in stages_of(results.config):
            if stage.name in parts and results.is_done(stage.name):
                _note_jobs(done, parts[stage.name], stage, results.config)
    paces: dict[str, Pace] = {}
    taken: dict[str, int] = {}
    outlooks = []
    for name, stages in selected.items():
        parts, config = runs[name].parts, runs[name].config
        kinds: dict[str, list[Stage]] = {"finished": [], "shared": [], "own": []}
        for stage in stages:
            part, jobs = parts[stage.name], stage.cost(config).jobs
            is_done, is_taken = (jobs <= known.get(part, 0) for known in (done, taken))
            kinds["finished" if is_done else "shared" if is_taken else "own"].append(stage)
            _note_jobs(taken, part, stage, config)
        environment = fingerprint([config.environment.id, config.environment.settings()])
        if environment not in paces:
            paces[environment] = pace_of(config)
        costs = [paces[environment].cost(stage, config) for stage in kinds["own"]]
        seconds = sum(START_S + cost.seconds for cost in costs)
        cost = StageCost(sum(cost.env_steps for cost in costs), seconds, 1)
        names = {kind: [stage.name for stage in those] for kind, those in kinds.items()}
        outlooks.append(Outlook(name, cost, **names))
    return outlooks


def _note_jobs(known: dict[str, int], part: str, stage: Stage, config: RunConfig) -> None:
    known[part] = max(known.get(part, 0), stage.cost(config).jobs)


def table_cost(found: Sequence[Outlook], workers: int | None) -> RunCost:
    """Return what the rest of an experiment will cost, as one stage whose jobs are its runs."""
    seconds = {each.name: each.cost.seconds for each in found}
    at_once = max(1, min(workers or 1, usable_cores(), sum(each.cost.env_steps > 0 for each in found)))
    steps, total = sum(each.cost.env_steps for each in found), sum(seconds.values())
    together = max(total / at_once, max(seconds.values(), default=0.0))
    shares = {name: each / total for name, each in seconds.items()} if total else {}
    return RunCost({"table": StageCost(steps, together, len(found), shares)}, workers)


def pace_of(config: RunConfig) -> Pace:
    """Return how fast this machine is with the imitator's environment.

    Raises UnusableEnvironmentError for one that does not do what it should.
    """
    environment, count = config.environment, config.imitation.gail.simulators_per_group
    simulators = make_batch(environment.id, environment.dynamics, count)
    try:
        step_s = step_seconds(simulators)
    except (RuntimeError, FloatingPointError) as error:
        raise UnusableEnvironmentError(str(error)) from error
    return Pace(step_s, simulators.max_episode_steps, REFERENCE_STEPS_PER_S * hopper_seconds())


def hopper_seconds() -> float:
    """Return how long a step of Hopper takes on one core."""
    return step_seconds(make_batch("oodil/Hopper-v0", {}, 8))


def step_seconds(simulators: Simulators) -> float:
    """Return how long a step of one of these simulators takes under random actions."""
    count = simulators.num_simulators
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
