"""How fast this machine is: the learner loop of a configuration by the number of rollout workers, and bare physics."""

import os
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from oodil.pipeline.artifacts import Files, RunDirectory
from oodil.pipeline.config import EnvironmentConfig, RunConfig
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.environments import make_batch
from oodil.pipeline.stage import JobContext, Run, Stage, register
from oodil.workers.local_engine import LocalEngine
from oodil.workers.reports import AttemptFailed, Event, Progress

WARM_UP = 0.3
"""Share of a learner's run that is not counted: processes start, and untrained robots fall all the time."""
TIME_FORMAT = "%Y-%m-%dT%H:%M:%SZ"
ITERATIONS = 60
"""Of the learner, for each number of workers that `compare` tries."""


def compare(
    config: RunConfig, counts: list[int], on_result: Callable[[int, dict[str, float]], None]
) -> dict[int, dict[str, float]]:
    """Measure each number of workers in turn; see `learner_rate`."""
    gail = config.imitation.gail
    short = gail.model_copy(update={"total_steps": ITERATIONS * gail.steps_per_iteration})
    shortened = config.model_copy(update={"imitation": config.imitation.model_copy(update={"gail": short})})
    results = {}
    for workers in counts:
        results[workers] = learner_rate(shortened, workers)
        on_result(workers, results[workers])
    return results


def usable_cores() -> int:
    """Return the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_counts() -> list[int]:
    """Return the numbers of workers worth trying here: none, and powers of two up to the number of cores."""
    cores = usable_cores()
    return [0, *(2**i for i in range(cores.bit_length()) if 2**i <= cores)]


def learner_rate(config: RunConfig, workers: int) -> dict[str, float]:
    """Return steps per second of the learner loop after its warm-up, and the mean episode length at its end."""
    seen: list[tuple[float, Progress]] = []

    def on_event(event: Event) -> None:
        if isinstance(event.report, Progress):
            seen.append((time.perf_counter(), event.report))
        elif isinstance(event.report, AttemptFailed):
            raise RuntimeError(event.report.reason)

    with tempfile.TemporaryDirectory() as folder:
        run = Run(config, RunDirectory(Path(folder)))
        run.directory.config.write_text(config.model_dump_json())
        LocalEngine(workers).run_jobs(LearnerLoop(), run, ["loop"], on_event, lambda: False)
    timed = [(at, report) for at, report in seen if report.done >= WARM_UP * report.total]
    (start, first), (end, last) = timed[0], timed[-1]
    length = last.metrics.get("length", float("nan"))
    return {"steps_per_s": (last.done - first.done) / (end - start), "episode_length": length}


def raw_rate() -> float:
    """Return how many control steps of Hopper, four substeps of bare ``mj_step`` each, one core takes in a second."""
    import gymnasium
    import mujoco

    model = gymnasium.make("Hopper-v5").unwrapped.model  # type: ignore[attr-defined]
    data = mujoco.MjData(model)
    started = time.perf_counter()
    for step in range(10_000):
        if step % 500 == 0:
            mujoco.mj_resetData(model, data)
        mujoco.mj_step(model, data, nstep=4)
    return 10_000 / (time.perf_counter() - started)


def machine() -> dict[str, Any]:
    """Describe where the figures come from; ``kernels`` are what the processor has torch compute with."""
    import torch

    model = "unknown"
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
    return {
        "platform": platform.platform(),
        "cpu": model,
        "kernels": torch.backends.cpu.get_cpu_capability(),
        "cores": os.cpu_count(),
        "load_average_before": os.getloadavg(),
        "time": time.strftime(TIME_FORMAT, time.gmtime()),
    }


class LearnerLoop(Stage):
    """The training of the imitation stage without anything around it."""

    name = "loop"
    version = 1
    inputs: tuple[str, ...] = ()
    distributed = True

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return nothing: no artifact of it is ever reused."""
        return {}

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Train and forget."""
        from oodil.pipeline.algorithms.gail import AdversarialReward
        from oodil.pipeline.algorithms.learner import Learner
        from oodil.pipeline.training import train

        environment, gail = run.config.environment, run.config.imitation.gail
        demonstrations = random_demonstrations(environment)
        weights = np.linspace(0.1, 1.0, len(demonstrations))
        simulators = make_batch(environment.id, environment.dynamics, 1)
        reward = AdversarialReward(demonstrations, weights, gail.discriminator, simulators.max_episode_steps, 0)
        learner = Learner(simulators.observation_dim, simulators.action_dim, gail, reward, 0)
        train(learner, environment, gail, [], context, self.checkpoints(run, job))
        return {}


def random_demonstrations(environment: EnvironmentConfig, count: int = 10) -> Demonstrations:
    """Return demonstrations of random actions: what is imitated does not matter for speed, only how much of it."""
    batch = make_batch(environment.id, environment.dynamics, count)
    num_states = batch.max_episode_steps + 1
    rng = np.random.default_rng(0)
    for n in range(count):
        batch.reset(n, seed=n)
    states = np.empty((count, num_states, batch.observation_dim), np.float32)
    for t in range(num_states):
        states[:, t] = batch.observations()
        batch.step(rng.uniform(-1, 1, (count, batch.action_dim)))
    return Demonstrations.of([Episode(part) for part in states], "random")


register(LearnerLoop())
