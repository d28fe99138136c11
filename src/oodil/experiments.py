"""The runs of an experiment, each as one job of an engine: dispatch, retries and Ctrl-C are those of any job.

A job executes its run inline, so as many runs are at work at once as the engine has workers. What runs have in common
is computed once: whoever comes first computes it, the others do something else meanwhile, or wait, and take it over.
What the tables beside this one have finished is taken over, too.
"""

import json
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from oodil.bench import machine, raw_rate
from oodil.orchestrator import Observer, check_inputs, execute, finished, open_run, read_run, refuse_to_replace
from oodil.pipeline.artifacts import MADE, RESULTS, Files, RunDirectory, encode_json, write_artifact, write_file
from oodil.pipeline.config import RunConfig
from oodil.pipeline.errors import ConfigError, OodilError, StorageError, UnfinishedError
from oodil.pipeline.experiment import ExperimentConfig, PlannedRun, parts_of, plan
from oodil.pipeline.locks import held
from oodil.pipeline.records import records
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import JobContext, JobStoppedError, Run, Stage, register
from oodil.pipeline.stages import stages as stages_of
from oodil.pipeline.versions import library_versions
from oodil.workers.engine import POLL_S, Engine, Outcome
from oodil.workers.local_engine import LocalEngine
from oodil.workers.reports import DONE, Event, Finished, Progress, Warn

LEAST_STEPS = 10_000
"""What a stage counts for in the progress of a run, if it takes fewer environment steps."""
SHORTEST_S = 0.05
"""A run that took less is not in what a table says of its making."""
_PLAN = "plan.json"


@dataclass(frozen=True)
class Table:
    """An experiment and where its runs lie."""

    experiment: ExperimentConfig
    runs: list[PlannedRun]
    folder: Path

    @classmethod
    def of(cls, experiment: ExperimentConfig, folder: Path) -> "Table":
        """Plan all runs and look at what they need. Raises OodilError for what cannot be; nothing is written."""
        runs = plan(experiment)
        for config in {run.config.name: run.config for run in runs}.values():
            check_inputs(config)
        return cls(experiment, runs, folder)

    @property
    def runner(self) -> RunDirectory:
        """What the engine needs, and the logs of its processes; the runs lie beside it."""
        return RunDirectory(self.folder / "runner")

    def opened(self, run: PlannedRun) -> Run:
        """Return a planned run as a run of its folder, whether or not it has begun."""
        return Run(run.config, RunDirectory(self.folder / run.name))

    @cached_property
    def beside(self) -> dict[str, dict[str, str]]:
        """What runs of the tables beside this one have in common with it, as parts by the run's path.

        Paths begin in the folder of all tables. Runs that cannot be read any more have nothing in common with it.
        """
        own, found = {part for run in self.runs for part in run.parts.values()}, {}
        for file in sorted(self.folder.parent.glob(f"*/*/{self.runner.config.name}")):
            if file.parents[1].name == self.folder.name:
                continue
            try:
                parts = parts_of(read_run(file.parent).config)
            except OodilError:
                continue
            if common := {stage: part for stage, part in parts.items() if part in own}:
                found["/".join(file.parts[-3:-1])] = common
        return found

    def select(self, rows: Collection[str] | None, methods: Collection[str] | None) -> dict[str, list[Stage]]:
        """Return the stages that some rows and methods need, by run, the longest run first.

        Raises ConfigError for a row or method that there is not.
        """
        known = {"row": list(self.experiment.rows), "method": [method.name for method in self.experiment.methods]}
        for kind, names in (("row", rows), ("method", methods)):
            for name in names or ():
                if name not in known[kind]:
                    raise ConfigError(f"{self.experiment.name}: no {kind} {name!r}; there are {', '.join(known[kind])}")
        found = {run.name: run.stages(methods or known["method"]) for run in self.runs if not rows or run.row in rows}
        configs = {run.name: run.config for run in self.runs}
        by_length = sorted(found, key=lambda name: -sum(each.cost(configs[name], 0.0).core_s for each in found[name]))
        return {name: found[name] for name in by_length if found[name]}

    def unfinished(self, selected: dict[str, list[Stage]]) -> dict[str, list[Stage]]:
        """Return those of the selected runs of which a selected stage is not there yet."""
        results = {run.name: RunResults(self.opened(run)) for run in self.runs if run.name in selected}
        return {
            name: stages
            for name, stages in selected.items()
            if not all(results[name].is_done(stage.name) for stage in stages)
        }

    def compute(
        self,
        selected: dict[str, list[Stage]],
        engine: Engine,
        on_event: Callable[[Event], None],
        should_stop: Callable[[], bool],
    ) -> Outcome:
        """Bring the selected stages of every run to their finished artifacts; what is finished is reused.

        Raises ConfigError, and leaves everything as it is, if a run is there with other settings, or if another process
        works on the table.
        """
        for run in self.runs:
            if run.name in selected:
                _refuse_other_settings(self.opened(run))
        try:
            self.runner.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"{self.folder}: {error.strerror or error}") from error
        with held(self.runner.path / ".lock") as is_held:
            if not is_held:
                raise ConfigError(f"{self.folder}: another process is working on this table")
            configs = {run.name: run.config for run in self.runs}
            for name in selected:
                open_run(self.folder / name, configs[name])
            chosen = {name: [stage.name for stage in found] for name, found in selected.items()}
            parts = {run.name: run.parts for run in self.runs}
            described = {"chosen": chosen, "parts": parts, "beside": self.beside}
            write_file(self.runner.path / _PLAN, encode_json(described))
            whole = Run(configs[next(iter(selected))], self.runner)
            write_file(self.runner.config, (whole.config.model_dump_json(indent=2) + "\n").encode())
            return engine.run_jobs(WholeRuns(), whole, list(selected), on_event, should_stop)

    def write_results(self, failed: Mapping[str, str]) -> Path:
        """Write what is known by now; return the file."""
        found = records(self.experiment, self.runs, self.folder, failed)
        path = self.folder / RESULTS
        write_file(path, encode_json(found, sort_keys=False))
        return path

    def write_made(self, command: Sequence[str]) -> Path:
        """Add to how it was made: by which command, on what machine, how fast; return the file.

        Seconds are of the stages that were finished since the last command that is there.
        """
        path = self.folder / MADE
        earlier = json.loads(path.read_bytes()) if path.exists() else []
        spent = {run.name: sum(RunResults(self.opened(run)).seconds().values()) for run in self.runs}
        for each in earlier:
            for name, seconds in each["seconds"].items():
                spent[name] = spent.get(name, 0) - seconds
        circumstances = {
            # Nobody else has these folders.
            "command": ["oodil", *(Path(each).name if Path(each).is_absolute() else each for each in command)],
            "machine": machine(),
            "raw_hopper_steps_per_s": raw_rate(),
            "versions": library_versions(),
            "seconds": {name: round(seconds, 1) for name, seconds in spent.items() if seconds > SHORTEST_S},
        }
        write_file(path, encode_json([*earlier, circumstances]))
        return path


def _refuse_other_settings(run: Run) -> None:
    try:
        refuse_to_replace(run, ())
    except ConfigError as error:
        reason = str(error).partition("; --force")[0]
        raise ConfigError(f"{reason}; choose another --folder, or remove that run") from None


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
        folder, described = run.directory.path.parent, json.loads((run.directory.path / _PLAN).read_bytes())
        own, chosen = read_run(folder / job), described["chosen"][job]
        parts, beside = described["parts"], described["beside"]
        stages = [stage for stage in stages_of(own.config) if stage.name in chosen]
        shown, reasons = _Shown(own, stages, context), list[str]()
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
                    reason = _execute(stage, own, shown, context)
                stages.remove(stage)
                if reason:
                    reasons.append(reason)
                    stages = _without_what_follows(stage, stages)
                break
            else:
                shown.wait()
        if reasons:
            raise RuntimeError("\n".join(reasons))
        return {}


def _execute(stage: Stage, run: Run, observer: Observer, context: JobContext) -> str:
    """Bring a stage to its finished artifact; return why it failed, or nothing."""
    # A failed job is tried again with its whole run, by the engine that runs the runs.
    runtime = run.config.runtime.model_copy(update={"max_attempts": 1})
    once = Run(run.config.model_copy(update={"runtime": runtime}), run.directory)
    try:
        execute(once, [stage], LocalEngine(0), observer, context.should_stop)
    except UnfinishedError as error:
        if not error.failed:
            raise JobStoppedError(str(error)) from None
        return "\n".join(error.failed.values())
    return ""


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
            stage.name: 0 if results.is_done(stage.name) else max(stage.cost(run.config, 0.0).env_steps, LEAST_STEPS)
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
