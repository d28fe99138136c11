"""The runs of an experiment, each as one job of an engine: dispatch, retries and Ctrl-C are those of any job.

A job executes its run inline, so as many runs are at work at once as the engine has workers; what a job does is in
`oodil.whole_runs`.
"""

import calendar
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Any

from oodil.bench import TIME_FORMAT, machine, raw_rate
from oodil.orchestrator import check_inputs, open_run, read_run, refuse_to_replace
from oodil.pipeline.artifacts import MADE, RESULTS, RunDirectory, encode_json, read_made, write_file
from oodil.pipeline.errors import ConfigError, OodilError, StorageError
from oodil.pipeline.experiment import ExperimentConfig, PlannedRun, parts_of, plan
from oodil.pipeline.locks import held
from oodil.pipeline.records import records
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import Run, Stage
from oodil.pipeline.versions import library_versions
from oodil.whole_runs import PLAN, WholeRuns
from oodil.workers.engine import Engine, Outcome
from oodil.workers.reports import Event

SHORTEST_S = 0.05
"""A run that took less is not in what a table says of its making."""


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
            if file.parents[1].name == self.folder.name or file.parent.name == self.runner.path.name:
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
        by_length = sorted(found, key=lambda name: -sum(each.cost(configs[name]).compute_s for each in found[name]))
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
        works on the table; DataError if what is known of earlier commands cannot be read.
        """
        for run in self.runs:
            if run.name in selected:
                _refuse_other_settings(self.opened(run))
        read_made(self.folder)
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
            write_file(self.runner.path / PLAN, encode_json(described))
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

        Seconds are those that were spent on stages since the last command that is there. One that spent none is left
        out.
        """
        path, earlier = self.folder / MADE, read_made(self.folder)
        spent = {run.name: _seconds_since(RunResults(self.opened(run)), run.name, earlier) for run in self.runs}
        seconds = {name: round(each, 1) for name, each in spent.items() if each > SHORTEST_S}
        if earlier and not seconds:
            return path
        circumstances = {
            # Nobody else has these folders.
            "command": ["oodil", *(Path(each).name if Path(each).is_absolute() else each for each in command)],
            "machine": machine(),
            "raw_hopper_steps_per_s": raw_rate(),
            "versions": library_versions(),
            "seconds": seconds,
        }
        write_file(path, encode_json([*earlier, circumstances]))
        return path


def _seconds_since(results: RunResults, name: str, made: Sequence[Mapping[str, Any]]) -> float:
    """Return what was spent on a run since the commands that are known; those before it was removed do not count."""
    began = results.began_at()
    known = [each["seconds"].get(name, 0.0) for each in made if _ended_at(each) > began]
    return results.seconds_ever() - sum(known)


def _ended_at(made: Mapping[str, Any]) -> float:
    """Return the end of the second in which a command noted how it was made; infinity if it did not say."""
    try:
        return calendar.timegm(time.strptime(made.get("machine", {}).get("time"), TIME_FORMAT)) + 1.0
    except (TypeError, ValueError):
        return inf


def _refuse_other_settings(run: Run) -> None:
    try:
        refuse_to_replace(run, ())
    except ConfigError as error:
        reason = str(error).partition("; --force")[0]
        raise ConfigError(f"{reason}; choose another --folder, or remove that run") from None
