"""A stage that is cheap and says in files what happened to it, and a configuration for it."""

import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from oodil.pipeline.artifacts import Files, RunDirectory, encode_arrays
from oodil.pipeline.collecting import RolloutSource, nothing_follows
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Unit, UnitResult
from oodil.pipeline.loading import parse_config
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.stage import JobContext, JobStoppedError, Run, Stage, register
from oodil.workers.reports import AttemptFailed, Event

NUM_GROUPS = 4


def hopper_policy(seed: int = 0) -> GaussianPolicy:
    """Return a small random policy for Hopper."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return 0.3 * rng.standard_normal(shape, dtype=np.float32)

    return GaussianPolicy(
        weights=(normal(12, 8), normal(8, 3)),
        biases=(normal(8), normal(3)),
        log_std=normal(3) - 1,
        input_mean=normal(12),
        input_scale=np.ones(12, np.float32),
    )


def hopper_units(
    iteration: int, count: int = NUM_GROUPS, num_steps: int = 20, env_id: str = "oodil/Hopper-v0"
) -> list[Unit]:
    """Return the units of an iteration in which every group starts afresh."""
    return [
        Unit(
            iteration=iteration,
            group=group,
            env_id=env_id,
            dynamics=(("gravity", 12.0),),
            num_simulators=2,
            num_steps=num_steps,
            policy_version=iteration,
            policy=hopper_policy(iteration),
            key=derive_key(7, "rollout", group, iteration),
            snapshot=None,
        )
        for group in range(count)
    ]


def chain(rollouts: RolloutSource, iterations: int) -> list[UnitResult]:
    """Collect several iterations, in which each group goes on from where it ended; return all results."""

    def follow(result: UnitResult) -> list[Unit]:
        return [replace(hopper_units(result.iteration + 1)[result.group], snapshot=result.snapshot)]

    rollouts.submit(hopper_units(0))
    results = []
    for iteration in range(iterations):
        results += rollouts.gather(follow if iteration + 1 < iterations else nothing_follows)
    return results


class FakeStage(Stage):
    """Each iteration it collects and adds up; a job's name says what else happens to it.

    ``raises`` raises in every attempt after its second iteration, ``raises_often`` after each iteration, ``killed``
    kills its own process once, in the middle, ``killed_often`` after each iteration, ``frozen`` stops its own process
    once, ``hangs`` sleeps for an hour once, and ``waits`` does not end before the file ``go`` is in the run directory.
    """

    version = 1
    inputs = ()

    def __init__(self, distributed: bool) -> None:
        self.name = "learner" if distributed else "jobs"
        self.distributed = distributed
        self.num_iterations = 6

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Nothing changes it."""
        return {}

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Add up what was collected, with a checkpoint after each iteration."""
        folder = run.directory.path
        note(folder / f"{job}.attempts", str(os.getpid()))
        arrays, _ = self.checkpoints(run, job).load()
        iteration, total = (int(arrays["iteration"]), arrays["total"]) if arrays else (0, np.zeros((2, 12)))
        note(folder / f"{job}.began_at", str(iteration))
        while iteration < self.num_iterations:
            if job == "raises" and iteration == 2:
                raise ArithmeticError(f"told to, in attempt {len(lines(folder / 'raises.attempts'))}")
            context.rollouts.submit(hopper_units(iteration))
            results = context.rollouts.gather()
            for group, result in enumerate(results):
                assert (result.iteration, result.group) == (iteration, group)
                total = total * 1.1 + result.rollout.observations[-1]
            iteration += 1
            self.checkpoints(run, job).save(iteration, {"iteration": np.array(iteration), "total": total})
            # Noted once the checkpoint is safe, so that a test that waits for the note knows where a resume begins.
            note(folder / f"{job}.iterations", str(iteration))
            context.progress(iteration, self.num_iterations, reward=float(total.mean()))
            if job == "raises_often":
                raise ArithmeticError("told to, after each iteration")
            if job == "killed_often":
                os.kill(os.getpid(), signal.SIGKILL)
            first = len(lines(folder / f"{job}.attempts")) == 1
            if job in ("killed", "frozen") and iteration == 3 and first:
                os.kill(os.getpid(), signal.SIGKILL if job == "killed" else signal.SIGSTOP)
            if job == "hangs" and iteration == 3 and first:
                time.sleep(3600)
            while job == "waits" and iteration == 2 and not (folder / "go").exists() and not context.should_stop():
                time.sleep(0.01)
            if context.should_stop():
                raise JobStoppedError
        return {"total.safetensors": encode_arrays({"total": total})}


register(FakeStage(distributed=False))
register(FakeStage(distributed=True))


def fake_run(path: Path, **runtime: Any) -> Run:
    """Return a run in a fresh directory, with fast restarts and a checkpoint after every iteration."""
    training = {"total_steps": 1000}
    config = parse_config(
        {
            "name": "fake",
            "environment": {},
            "demonstrations": {"file": "none.safetensors"},
            "transferability": {"gail": training},
            "imitation": {"gail": training},
            "runtime": {"restart_delay_s": 0.01, "checkpoint_interval_s": 0.0, **runtime},
        },
        origin="fake",
    )
    directory = RunDirectory(path)
    path.mkdir(parents=True, exist_ok=True)
    directory.config.write_text(config.model_dump_json())
    return Run(config, directory)


def failures(events: list[Event]) -> list[tuple[str, int, bool]]:
    """Return (job, attempt, whether there is another) of every attempt that failed."""
    return [
        (event.name, event.report.attempt, event.report.will_retry)
        for event in events
        if isinstance(event.report, AttemptFailed)
    ]


def note(path: Path, line: str) -> None:
    """Add a line to a file."""
    with open(path, "a") as file:
        file.write(line + "\n")


def lines(path: Path) -> list[str]:
    """Return the lines of a file; none if there is no file."""
    return path.read_text().splitlines() if path.exists() else []


def wait_until(condition: Any, timeout_s: float = 30.0) -> None:
    """Wait for a condition. Raises TimeoutError when it does not come true."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"still not true after {timeout_s:g} s")
        time.sleep(0.01)
