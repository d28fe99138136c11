"""One run of a table: the job that computes it, whatever other runs have of it.

Whoever comes first to what runs have in common computes it; the others do something else meanwhile, or wait, and take
it over. What the tables beside this one have finished is taken over, too.
"""

import json
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from oodil.orchestrator import Observer, execute, read_run
from oodil.pipeline.artifacts import Files, RunDirectory, finished, write_artifact
from oodil.pipeline.config import RunConfig
from oodil.pipeline.errors import UnfinishedError
from oodil.pipeline.locks import held
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import JobContext, JobStoppedError, Run, Stage, register
from oodil.pipeline.stages import stages as stages_of
from oodil.workers.engine import POLL_S
from oodil.workers.local_engine import LocalEngine
from oodil.workers.reports import DONE, Event, Finished, Progress, Warn

PLAN = "plan.json"
"""What the jobs of a table need to know: which stages of each run are chosen, and what is in common with others."""
LEAST_STEPS = 10_000
"""What a stage counts for in the progress of a run, if it takes fewer environment steps."""


class WholeRuns(Stage):
    """A stage whose jobs are the runs of a table; what they leave behind lies in their own folders."""

    name = "table"
    version = 1
    inputs = ()

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return nothing: each run knows by itself what is finished."""
        return {}

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Execute one run inline. A stage that fails leaves those alone that do not read from it."""
        folder, described = run.directory.path.parent, json.loads((run.directory.path / PLAN).read_bytes())
        own, chosen = read_run(folder / job), described["chosen"][job]
        parts, beside = described["parts"], described["beside"]
        stages = [stage for stage in stages_of(own.config) if stage.name in chosen]
        shown, failures = _Shown(own, stages, context), list[UnfinishedError]()
        while stages:
            for stage in [each for each in stages if not {other.name for other in stages}.intersection(each.inputs)]:
                part = parts[job][stage.name]
                others = [name for name in parts if name != job and parts[name].get(stage.name) == part]
                lock = run.directory.path / "locks" / part
                lock.parent.mkdir(exist_ok=True)
                with held(lock) if others else nullcontext(True) as is_mine:
                    if not is_mine:
                        continue
                    mates = [RunDirectory(folder / name) for name in others]
                    elsewhere = [path for path in beside if beside[path].get(stage.name) == part]
                    _take_over(stage, own, mates, [RunDirectory(folder.parent / path) for path in elsewhere])
                    failure = _execute(stage, own, shown, context)
                stages.remove(stage)
                if failure:
                    failures.append(failure)
                    stages = _without_what_follows(stage, stages)
                break
            else:
                shown.wait()
        if failures:
            raise _together(failures)
        return {}


def _together(failures: Sequence[UnfinishedError]) -> UnfinishedError:
    """Return one failure of a run: all reasons, and at the end a line for each stage."""
    reasons = {failure.stage: "\n".join(failure.failed.values()) for failure in failures}
    lines = [f"{stage}: {reason.strip().splitlines()[-1]}" for stage, reason in reasons.items()]
    is_final = all(failure.is_final for failure in failures)
    return UnfinishedError("\n".join([*reasons.values(), *lines]), WholeRuns.name, reasons, is_final)


def _execute(stage: Stage, run: Run, observer: Observer, context: JobContext) -> UnfinishedError | None:
    """Bring a stage to its finished artifact; return how it failed, if it did."""
    # A failed job is tried again with its whole run, by the engine that runs the runs.
    runtime = run.config.runtime.model_copy(update={"max_attempts": 1})
    once = Run(run.config.model_copy(update={"runtime": runtime}), run.directory)
    try:
        execute(once, [stage], LocalEngine(0), observer, context.should_stop)
    except UnfinishedError as error:
        if not error.failed:
            raise JobStoppedError(str(error)) from None
        return error
    return None


def _without_what_follows(failed: Stage, stages: Sequence[Stage]) -> list[Stage]:
    """Return those of some stages, each after those it reads from, that do not need one that failed."""
    lost, left = {failed.name}, []
    for stage in stages:
        if lost.intersection(stage.inputs):
            lost.add(stage.name)
        else:
            left.append(stage)
    return left


def _take_over(stage: Stage, run: Run, others: Sequence[RunDirectory], elsewhere: Sequence[RunDirectory]) -> None:
    """Copy what other runs have finished of a stage, and go on with the jobs that those of this table have begun.

    An artifact of the same origin has the same bytes, whoever made it; what runs elsewhere have begun may be at work.
    """
    for job in stage.jobs(run):
        theirs = [other.job(stage.name, job) for other in (*others, *elsewhere)]
        if _is_there(run.directory.job(stage.name, job), stage.job_origin(run, job), theirs):
            stage.checkpoints(run, job).clear()
            continue
        own = stage.checkpoints(run, job)
        begun = [path for other in others if (path := other.checkpoints(stage.name, job)).exists()]
        if begun and not own.exist():
            own.clear()
            own.folder.parent.mkdir(parents=True, exist_ok=True)
            begun[0].rename(own.folder)
    if all(finished(run.directory.job(stage.name, job), stage.job_origin(run, job)) for job in stage.jobs(run)):
        theirs = [other.stage(stage.name) for other in (*others, *elsewhere)]
        _is_there(run.directory.stage(stage.name), stage.origin(run), theirs)


def _is_there(path: Path, origin: dict[str, Any], others: Sequence[Path]) -> bool:
    """Return whether a finished artifact of an origin lies at ``path``, if need be by copying one of some others."""
    if finished(path, origin):
        return True
    for other in others:
        there = finished(other, origin)
        if there:
            write_artifact(path, origin, there.files(), there.versions)
            return True
    return False


class _Shown(Observer):
    """Tells a job's context how far its run is, in environment steps of what was not finished when it began."""

    def __init__(self, run: Run, stages: Sequence[Stage], context: JobContext) -> None:
        self._run = run
        self._stages = {stage.name: stage for stage in stages}
        self._context = context
        results = RunResults(run)
        self._steps = {
            stage.name: 0 if results.is_done(stage.name) else max(stage.cost(run.config).env_steps, LEAST_STEPS)
            for stage in stages
        }
        self._total = max(1, sum(self._steps.values()))
        self._behind = 0
        self._stage, self._jobs, self._ended = "", 1, 0

    def wait(self) -> None:
        """Wait a little for what another run computes. Raises JobStoppedError if a stop was asked for."""
        if self._context.should_stop():
            raise JobStoppedError("stopped while waiting for another run")
        time.sleep(POLL_S)
        self._context.progress(self._behind, self._total)

    def stage_reused(self, stage: str) -> None:
        """Count what need not be computed."""
        self._behind += self._steps[stage]

    def stage_started(self, stage: str, reason: str, jobs: int) -> None:
        """Begin with a stage, of whose jobs some may be there."""
        self._stage, self._jobs = stage, len(self._stages[stage].jobs(self._run))
        self._ended = self._jobs - jobs

    def stage_finished(self, stage: str, seconds: float) -> None:
        """Count what was computed."""
        self._behind += self._steps[stage]
        self._context.progress(self._behind, self._total)

    def event(self, event: Event) -> None:
        """Pass on how far the job of the present stage is, and what the user should see."""
        match event.report:
            case Progress(done, total, metrics):
                share = (self._ended + done / max(total, 1)) / self._jobs
                done_steps = self._behind + int(share * self._steps[self._stage])
                self._context.progress(min(done_steps, self._total), self._total, **metrics)
            case Finished(outcome) if outcome == DONE:
                self._ended += 1
            case Warn(text):
                self._context.warn(f"{self._stage}: {text}")


register(WholeRuns())
