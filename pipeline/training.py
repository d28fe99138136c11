"""The training loop that experts, cluster jobs and the final learner share.

Iteration i is collected under policy version i - lag (iteration 0 under version 0). With lag 1 a group begins iteration
i + 1 as soon as its own part of iteration i and update i - 1 are finished, so workers collect while the learner updates
and do not wait for the slowest group; the content of a unit does not depend on when it is handed out. All random
numbers are keyed by iteration, so a checkpoint holds no generator state.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from oodil.pipeline.algorithms.learner import Learner
from oodil.pipeline.artifacts import Checkpoints, below, nested
from oodil.pipeline.collecting import RolloutSource, nothing_follows
from oodil.pipeline.config import EnvironmentConfig, TrainingConfig
from oodil.pipeline.data import Snapshot, TransitionBatch, Unit, UnitResult
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.seeding import derive_key, torch_seed
from oodil.pipeline.stage import JobContext, JobStoppedError

Arrays = dict[str, NDArray]


@dataclass(frozen=True)
class Probe:
    """A measurement at regular points of a training, which it does not influence."""

    name: str
    count: int
    """Number of measurements, evenly spaced; the last one follows the last iteration."""
    measure: Callable[[], NDArray]
    """Returns an array of fixed shape."""
    second_half: bool = False
    """Whether all of them are made in the second half of the training."""

    def is_due(self, iteration: int, num_iterations: int) -> bool:
        """Return whether to measure after this iteration."""
        skipped = num_iterations // 2 if self.second_half else 0
        done, num_parts = iteration - skipped, num_iterations - skipped
        return done >= 0 and (done + 1) * self.count // num_parts > done * self.count // num_parts


class History:
    """The measurements of each probe, in order, with the environment steps at which they were made."""

    def __init__(self) -> None:
        self._steps: dict[str, list[int]] = {}
        self._values: dict[str, list[NDArray]] = {}

    def append(self, name: str, env_steps: int, value: NDArray) -> None:
        """Add one measurement."""
        self._steps.setdefault(name, []).append(env_steps)
        self._values.setdefault(name, []).append(np.asarray(value, np.float64))

    def steps(self, name: str) -> NDArray[np.int64]:
        """Return (P,) environment steps of a probe's measurements."""
        return np.array(self._steps.get(name, []), np.int64)

    def values(self, name: str) -> NDArray[np.float64]:
        """Return (P, ...) measurements of a probe; empty when there is none."""
        return np.stack(self._values[name]) if name in self._values else np.empty(0)

    def arrays(self) -> Arrays:
        """Return everything by name; `from_arrays` is the inverse."""
        named = {f"{name}/steps": self.steps(name) for name in self._steps}
        return named | {f"{name}/values": self.values(name) for name in self._values}

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> "History":
        """Rebuild a history from `arrays`."""
        history = cls()
        for key, steps in arrays.items():
            name, _, field = key.rpartition("/")
            if field == "steps":
                history._steps[name] = steps.tolist()
                history._values[name] = list(arrays[f"{name}/values"])
        return history


@dataclass
class _Position:
    """The state of a training between two iterations, besides the learner's."""

    iteration: int
    policy_version: int
    policy: GaussianPolicy
    """Collects the next iteration."""
    snapshots: list[Snapshot | None]
    history: History
    starts: NDArray[np.float32] | None

    def unit(self, group: int, root_seed: int, environment: EnvironmentConfig, config: TrainingConfig) -> Unit:
        """Return the unit of a group in the next iteration."""
        return Unit(
            iteration=self.iteration,
            group=group,
            env_id=environment.id,
            dynamics=tuple(sorted(environment.dynamics.items())),
            num_simulators=config.simulators_per_group,
            num_steps=config.steps_per_rollout,
            policy_version=self.policy_version,
            policy=self.policy,
            key=derive_key(root_seed, "rollout", group, self.iteration),
            snapshot=self.snapshots[group],
            starts=self.starts,
        )


def train(
    learner: Learner,
    environment: EnvironmentConfig,
    config: TrainingConfig,
    probes: list[Probe],
    context: JobContext,
    checkpoints: Checkpoints,
    starts: NDArray[np.float32] | None = None,
    rollouts: RolloutSource | None = None,
) -> History:
    """Train for the configured number of steps, from the newest checkpoint if there is one.

    Episodes begin at ``starts`` (P, S), if there are any; see `Unit`. Whoever collects for the context does so unless
    other ``rollouts`` are given.

    Each iteration reports to the context the metrics of `Learner.update`, and the mean ``return`` and ``length`` of the
    last hundred episodes of training once one has ended.

    Raises JobStoppedError, after writing a checkpoint, when the context asks for a stop.
    """
    torch.set_num_threads(config.torch_threads)
    position = _resume(learner, config, context, checkpoints, starts)
    source = context.rollouts if rollouts is None else rollouts

    def unit(group: int) -> Unit:
        return position.unit(group, learner.root_seed, environment, config)

    def follow(result: UnitResult) -> list[Unit]:
        position.snapshots[result.group] = result.snapshot
        return [unit(result.group)]

    last_checkpoint = time.monotonic()
    returns, lengths = _Recent(), _Recent()
    if position.iteration < config.num_iterations:
        source.submit([unit(group) for group in range(config.num_groups)])
    for iteration in range(position.iteration, config.num_iterations):
        is_last = iteration + 1 == config.num_iterations
        position.iteration = iteration + 1
        if config.lag == 1:
            position.policy, position.policy_version = learner.behavior_policy(), iteration
        results = source.gather(follow if config.lag == 1 and not is_last else nothing_follows)
        batch = TransitionBatch.of([result.rollout for result in results])
        position.snapshots = [result.snapshot for result in results]
        metrics = learner.update(batch, iteration)
        if config.lag == 0:
            position.policy, position.policy_version = learner.behavior_policy(), position.iteration
            if not is_last:
                source.submit([unit(group) for group in range(config.num_groups)])
        _refuse_divergence(metrics, iteration)

        env_steps = position.iteration * config.steps_per_iteration
        for probe in probes:
            if probe.is_due(iteration, config.num_iterations):
                position.history.append(probe.name, env_steps, probe.measure())
        returns.extend(batch.episode_returns)
        lengths.extend(batch.episode_lengths)
        context.progress(
            env_steps,
            config.env_steps,
            **metrics,
            **returns.mean("return"),
            **lengths.mean("length"),
        )
        stop = context.should_stop()
        if stop or time.monotonic() - last_checkpoint >= context.checkpoint_interval_s:
            _save(learner, position, checkpoints)
            last_checkpoint = time.monotonic()
        if stop and position.iteration < config.num_iterations:
            raise JobStoppedError(f"stopped after {env_steps} environment steps")
    return position.history


def experience(
    policy: GaussianPolicy,
    environment: EnvironmentConfig,
    config: TrainingConfig,
    num_steps: int,
    root_seed: int,
    context: JobContext,
    starts: NDArray[np.float32] | None = None,
) -> TransitionBatch:
    """Collect at least ``num_steps`` steps of every simulator under one policy, starting with new episodes.

    They begin at ``starts`` (P, S), if there are any; see `Unit`. Raises JobStoppedError when the context asks for a
    stop; there is no checkpoint, since it is a matter of seconds.
    """
    position = _Position(0, 0, policy, [None] * config.num_groups, History(), starts)
    seed = torch_seed(derive_key(root_seed, "experience"))
    rollouts = []
    while position.iteration * config.steps_per_rollout < num_steps:
        if context.should_stop():
            raise JobStoppedError(f"stopped after {position.iteration} rollouts of each group")
        context.rollouts.submit([position.unit(g, seed, environment, config) for g in range(config.num_groups)])
        results = context.rollouts.gather()
        rollouts += [result.rollout for result in results]
        position.snapshots = [result.snapshot for result in results]
        position.iteration += 1
    return TransitionBatch.of(rollouts)


class _Recent:
    """The mean over the last hundred finished episodes, for progress reports."""

    def __init__(self) -> None:
        self._values: list[float] = []

    def extend(self, values: NDArray) -> None:
        """Add one value per finished episode."""
        self._values.extend(values.tolist())
        del self._values[:-100]

    def mean(self, name: str) -> dict[str, float]:
        """Return the mean under ``name``, or nothing before the first episode has finished."""
        return {name: float(np.mean(self._values))} if self._values else {}


def _refuse_divergence(metrics: dict[str, float], iteration: int) -> None:
    """Raise FloatingPointError, naming the metrics, when one is not finite."""
    broken = [name for name, value in metrics.items() if not np.isfinite(value)]
    if broken:
        raise FloatingPointError(f"training diverged in iteration {iteration}: {', '.join(broken)} not finite")


def _save(learner: Learner, position: _Position, checkpoints: Checkpoints) -> None:
    """Write a checkpoint that `_resume` reads."""
    arrays: Arrays = {"position": np.array([position.iteration, position.policy_version], np.int64)}
    arrays |= nested("learner", {name: value.numpy() for name, value in learner.state_dict().items()})
    arrays |= nested("policy", position.policy.arrays()) | nested("history", position.history.arrays())
    for group, snapshot in enumerate(position.snapshots):
        assert snapshot is not None
        arrays |= nested(f"snapshot/{group}", vars(snapshot))
    checkpoints.save(position.iteration, arrays)


def _resume(
    learner: Learner,
    config: TrainingConfig,
    context: JobContext,
    checkpoints: Checkpoints,
    starts: NDArray[np.float32] | None,
) -> _Position:
    """Load the newest checkpoint into the learner and return its position; the initial one if there is none."""
    arrays, warnings = checkpoints.load()
    for warning in warnings:
        context.warn(warning)
    if arrays is None:
        fresh: list[Snapshot | None] = [None] * config.num_groups
        return _Position(0, 0, learner.behavior_policy(), fresh, History(), starts)
    learner.load_state_dict({name: torch.from_numpy(value.copy()) for name, value in below("learner", arrays).items()})
    iteration, version = (int(value) for value in arrays["position"])
    snapshots: list[Snapshot | None] = [Snapshot(**below(f"snapshot/{g}", arrays)) for g in range(config.num_groups)]
    policy = GaussianPolicy.from_arrays(below("policy", arrays))
    return _Position(iteration, version, policy, snapshots, History.from_arrays(below("history", arrays)), starts)
