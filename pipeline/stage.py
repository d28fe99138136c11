"""The contract of a stage, and what a running job sees of the runtime.

A stage is a name, a version, its inputs and one or more independent jobs. It never starts a process or opens a socket:
an engine (`oodil.workers.engine`) decides where its jobs run and who collects their rollouts.
"""

import importlib
import sys
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from oodil.pipeline.artifacts import Artifact, Checkpoints, Files, RunDirectory, finished, read_artifact
from oodil.pipeline.collecting import RolloutSource
from oodil.pipeline.config import RunConfig
from oodil.pipeline.errors import ConfigError, DamagedArtifactError, NotFinishedError


class JobStoppedError(Exception):
    """A job stopped because it was asked to, after writing a checkpoint."""


class JobContext(Protocol):
    """What a job may ask of the process it runs in."""

    rollouts: RolloutSource
    checkpoint_interval_s: float

    def progress(self, done: int, total: int, **metrics: float) -> None:
        """Report ``done`` of ``total`` environment steps (or iterations) and current figures; cheap to call often."""

    def warn(self, message: str) -> None:
        """Say something the user should see."""

    def should_stop(self) -> bool:
        """Return whether the job should checkpoint and raise JobStoppedError."""


@dataclass(frozen=True)
class Run:
    """A configuration and where its results lie; read-only for stages."""

    config: RunConfig
    directory: RunDirectory

    def artifact(self, stage: str) -> Artifact:
        """Return the finished artifact of an earlier stage. Raises NotFinishedError if it is not finished."""
        return _finished(read_artifact(self.directory.stage(stage)), stage)

    def job_artifact(self, stage: str, job: str) -> Artifact:
        """Return the finished artifact of a job of the same stage. Raises NotFinishedError if it is not finished."""
        return _finished(read_artifact(self.directory.job(stage, job)), f"{stage}/{job}")


def base_run(config: RunConfig) -> Run | None:
    """Return the run that a fine-tuning continues; None for any other run. Raises ConfigError if it cannot be read."""
    if config.finetuning.run is None:
        return None
    directory = RunDirectory(config.finetuning.run)
    try:
        return Run(RunConfig.model_validate_json(directory.config.read_bytes()), directory)
    except (OSError, ValueError) as error:
        raise ConfigError(f"finetuning.run: {directory.path} is not a run that can be continued ({error})") from error


def _finished(artifact: Artifact | None, name: str) -> Artifact:
    if artifact is None:
        raise NotFinishedError(f"{name} is not finished")
    return artifact


LEARNING_S = 25e-6
"""Seconds of one core of the reference machine that learning takes for each environment step."""


@dataclass(frozen=True)
class Cost:
    """What all jobs of a stage are expected to cost; what is not known before its inputs are is left out.

    How long steps and episodes take is the machine's affair. Seconds are those of one core of the reference machine,
    which takes 15,000 steps of Hopper in a second.
    """

    env_steps: int = 0
    """Of trainings."""
    episodes: int = 0
    """By which trainings are measured, and whose steps count among the run's."""
    other_episodes: int = 0
    """Whose steps do not: those of demonstrators, and of evaluations on the true return."""
    compute_s: float = 0.0
    """Seconds beside all steps."""
    jobs: int = 1

    @classmethod
    def of_training(cls, env_steps: int, jobs: int = 1) -> "Cost":
        """Return the cost of trainings that take so many environment steps together."""
        return cls(env_steps, compute_s=env_steps * LEARNING_S, jobs=jobs)


class Stage(ABC):
    """One step of the pipeline."""

    name: str
    version: int
    """Raise it when the meaning of the code changes, so that old artifacts are not reused."""
    inputs: tuple[str, ...]
    """Stages whose artifacts it reads."""
    distributed: bool = False
    """Whether rollout workers collect for its job; otherwise a job collects in its own process."""
    jobs_are_read: bool = False
    """Whether the artifacts of its jobs are read once it is finished, so that it is no more sound than they are."""

    @property
    def module(self) -> str:
        """The module that registers it; a process imports it before it runs a job of the stage."""
        return _MODULES.get(self.name, type(self).__module__)

    def check(self, config: RunConfig) -> None:  # noqa: B027 (most stages can always run)
        """Raise ConfigError, before any work, for a configuration in which this stage cannot run."""

    def check_files(  # noqa: B027 (most stages read nothing but other stages)
        self, config: RunConfig, observation_dim: int, run: Run | None = None
    ) -> None:
        """Raise DataError or ExpertError, before any work, for files that do not fit the imitator's environment.

        What a ``run`` has taken over from files is not looked for any more.
        """

    @abstractmethod
    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return everything in the configuration that changes the result, and nothing else, as JSON values.

        What is only reported (labels, marks, evaluation) stays out: a change of it must not compute anything again.
        """

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the part of the settings that its jobs depend on; all of it unless `combine` alone uses some."""
        return self.settings(config)

    def jobs(self, run: Run) -> list[str]:
        """Return the names of its independent jobs; one named as the stage by default."""
        return [self.name]

    @abstractmethod
    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Compute a job and return its artifact's files. Raises JobStoppedError when asked to stop."""

    def combine(self, run: Run) -> Files | None:
        """Return the stage's files, made of its jobs' artifacts; None when the only job's artifact is the stage's."""
        return None

    def env_steps(self, run: Run) -> int:
        """Return the environment steps that its finished artifact took; 0 for a stage without a simulator."""
        return 0

    def cost(self, config: RunConfig) -> Cost:
        """Return what it is expected to cost."""
        return Cost()

    def origin(self, run: Run) -> dict[str, Any]:
        """Return what names the stage's artifact: stage, version, seed, settings, and the content of its inputs."""
        return {
            "stage": self.name,
            "version": self.version,
            "seed": run.config.seed,
            "settings": self.settings(run.config),
            "inputs": {name: run.artifact(name).sha256 for name in self.inputs},
        }

    def job_origin(self, run: Run, job: str) -> dict[str, Any]:
        """Return what names a job's artifact and checkpoints."""
        origin = self.origin(run)
        return origin if job == self.name else origin | {"job": job, "settings": self.job_settings(run.config)}

    def checkpoints(self, run: Run, job: str) -> Checkpoints:
        """Return the checkpoints of a job."""
        return Checkpoints(run.directory.checkpoints(self.name, job), self.job_origin(run, job))


_REGISTRY: dict[str, Stage] = {}
_MODULES: dict[str, str] = {}
"""By stage, the module that registers it."""


def register(stage: Stage) -> None:
    """Make a stage known by its name; the last line of the file that defines it."""
    module = sys._getframe(1).f_globals["__name__"]  # The caller's: a class of ours may be a stage of somebody else.
    held, holder = _REGISTRY.setdefault(stage.name, stage), _MODULES.setdefault(stage.name, module)
    if held is not stage and holder != module:
        raise ValueError(f"a stage {stage.name!r} is registered by {holder} and by {module}")


_OURS = "oodil.pipeline.stages"
"""Importing it registers our own stages."""


def stage_named(name: str, module: str = _OURS) -> Stage:
    """Return a registered stage; importing ``module`` registers it. Raises ConfigError, naming those there are."""
    for each in (_OURS, module):
        importlib.import_module(each)
    if name not in _REGISTRY:
        raise ConfigError(f"no stage {name!r}; there are {', '.join(_REGISTRY)}")
    return _REGISTRY[name]


def registered() -> list[Stage]:
    """Return every stage that is known by now."""
    return list(_REGISTRY.values())


@dataclass(frozen=True)
class StageState:
    """Where a stage of a run stands."""

    state: Literal["done", "stale", "damaged", "partial", "pending"]
    """Stale: its artifact was made by other code, from other settings or from other inputs."""
    reason: str = ""
    """What is damaged, or the field that differs."""
    artifact: Artifact | None = None
    """There if it is done."""
    follows_input: bool = False
    """Whether it is stale only because an input was replaced, is missing, or cannot be used itself."""


def state_of(stage: Stage, run: Run) -> StageState:
    """Return where a stage stands, every file of its artifact checked."""
    path = run.directory.stage(stage.name)
    try:
        artifact = read_artifact(path)
        if artifact is None:
            return StageState("partial" if run.directory.has_begun(stage.name) else "pending")
        missing = [name for name in stage.inputs if read_artifact(run.directory.stage(name)) is None]
        if missing:
            return StageState("stale", f"its input {missing[0]} is missing", follows_input=True)
        origin = stage.origin(run)
        if not artifact.made_from(origin):
            inputs_alone = artifact.made_from(origin | {"inputs": artifact.origin.get("inputs")})
            return StageState("stale", origin_difference(artifact.origin, origin), follows_input=inputs_alone)
        artifact.verify()
    except DamagedArtifactError as error:
        return StageState("damaged", str(error))
    if stage.jobs_are_read:
        try:
            jobs = stage.jobs(run)
        except DamagedArtifactError:
            return StageState("stale", "an input is damaged", follows_input=True)
        for job in jobs:
            path = run.directory.job(stage.name, job)
            if finished(path, stage.job_origin(run, job)) is None:
                return StageState("damaged", f"{path}: missing, damaged or made from something else")
    return StageState("done", artifact=artifact)


def origin_difference(old: Any, new: Any, key: str = "") -> str:
    """Name the first place where two origins differ, as ``key old -> new``; empty where there is none."""
    if old == new:
        return ""
    if isinstance(old, dict) and isinstance(new, dict):
        name = next(name for name in sorted({*old, *new}) if old.get(name) != new.get(name))
        return origin_difference(old.get(name), new.get(name), f"{key}.{name}" if key else name)
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        i = next(i for i, (a, b) in enumerate(zip(old, new, strict=True)) if a != b)
        return origin_difference(old[i], new[i], f"{key}[{i}]")
    if key.startswith("inputs."):
        return f"its input {key.removeprefix('inputs.')} changed"
    return f"{key.removeprefix('settings.')} {old!r} -> {new!r}"
