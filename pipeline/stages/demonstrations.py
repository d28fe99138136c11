"""Stage 1: the demonstrations, collected from saved experts (one job per source) or read from a file."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from oodil.pipeline.artifacts import Files, read_artifact
from oodil.pipeline.config import DemonstrationsConfig, EnvironmentConfig, ExpertConfig, RunConfig
from oodil.pipeline.config.sections import is_same
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import read_demonstrations, read_file
from oodil.pipeline.environments import Simulators, environment_spec, make_batch
from oodil.pipeline.errors import DataError, ExpertError
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.policy import Controller, GaussianPolicy
from oodil.pipeline.results import CollectedDemonstrations
from oodil.pipeline.seeding import derive_key, numpy_rng
from oodil.pipeline.stage import Cost, JobContext, Run, Stage, base_run, register, state_of
from oodil.pipeline.stages.experts import load_expert, transfer_returns

COLLECTION_SIMULATORS = 16
"""Episodes collected side by side; part of what the demonstrations depend on."""


class CopyStage(Stage):
    """A stage that takes over what files hold, and needs them no more once it is done."""

    def origin(self, run: Run) -> dict[str, Any]:
        """Return what names the artifact.

        A finished one is a copy: once its file or an expert is gone, or the run is on another machine, what their
        content was is taken from there.
        """
        try:
            return super().origin(run)
        except (DataError, ExpertError):
            held = read_artifact(run.directory.stage(self.name))
            if held is None:
                raise
            return held.origin | {"version": self.version, "seed": run.config.seed}


class DemonstrationsStage(CopyStage):
    """Collects or reads; its artifact is `CollectedDemonstrations`, whose sources are numbered as configured.

    Labels and marks are not part of it: they are reported only, and stay in the configuration.
    """

    name = "demonstrations"
    version = 3
    inputs = ()

    def check_files(self, config: RunConfig, observation_dim: int, run: Run | None = None) -> None:
        """Raise DataError or ExpertError, before any work, if the demonstrations cannot fit the environment.

        A ``run`` that has taken them over needs neither their file nor their experts any more.
        """
        section = config.demonstrations
        if run is not None and state_of(self, run).state == "done":
            _check_count(config, len(load_demonstrations(run)), run.directory.path)
            return
        if section.file is not None:
            demonstrations, environment = read_demonstrations(section.file)
            _check_count(config, len(demonstrations), section.file)
            if demonstrations.observation_dim != observation_dim:
                raise DataError(
                    f"{section.file}: states have {demonstrations.observation_dim} dimensions; "
                    f"environment {config.environment.id} has {observation_dim}"
                )
            if environment and not is_same(environment, config.environment.id):
                raise DataError(
                    f"{section.file}: recorded in {environment}, but the run is for {config.environment.id}"
                )
            _check_labels(config, demonstrations)
        else:
            _check_count(config, sum(source.count for source in section.sources), "demonstrations.sources")
        for source in section.sources:
            check_expert(source, EnvironmentConfig(id=config.environment.id, dynamics=source.dynamics), observation_dim)

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the sources with the content of their experts, or the content of the file."""
        section = config.demonstrations
        common = {"environment": config.environment.id}
        if section.file is not None:
            base = base_run(config)
            before = {} if base is None else {"base": base.artifact(self.name).sha256}
            return common | before | {"file_sha256": hashlib.sha256(read_file(section.file)).hexdigest()}
        sources = [
            {"dynamics": source.dynamics, "count": source.count, "expert_sha256": identity(source)}
            for source in section.sources
        ]
        return common | flags(section) | {"sources": sources, "imitator": config.environment.dynamics}

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the settings without the imitator's dynamics, in which `combine` alone runs experts."""
        return {name: value for name, value in self.settings(config).items() if name != "imitator"}

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of whole episodes of every source, of which none has to be thrown away."""
        sources = config.demonstrations.sources
        if not sources:
            return Cost()
        rounds = sum(-(-source.count // COLLECTION_SIMULATORS) for source in sources)
        return Cost(other_episodes=rounds * COLLECTION_SIMULATORS, jobs=len(sources))

    def jobs(self, run: Run) -> list[str]:
        """Return one job per source, or the stage itself for a file."""
        return [f"source-{i}" for i in range(len(run.config.demonstrations.sources))] or [self.name]

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Collect from one source, or take over the file, after the demonstrations of the run that is continued."""
        config = run.config
        section = config.demonstrations
        if section.file is not None:
            _say_what_is_raw(config, context)
            demonstrations, _ = read_demonstrations(section.file)
            base = base_run(config)
            if base is not None:
                demonstrations = Demonstrations.joined([load_demonstrations(base), demonstrations])
            return CollectedDemonstrations(demonstrations, (), config.environment.id).files()
        index = self.jobs(run).index(job)
        if not index:
            _say_what_is_raw(config, context)
        source = section.sources[index]
        try:
            demonstrations, kept = collect_demonstrations(
                load_expert(source.expert_folder)[0] if source.expert_folder else None,
                EnvironmentConfig(id=config.environment.id, dynamics=source.dynamics),
                index,
                source.count,
                config.seed,
                context=context,
                **flags(section),
            )
        except DataError as error:
            raise DataError(f"source {source.label!r}: {error}") from error
        return CollectedDemonstrations(demonstrations, (kept,), config.environment.id).files()

    def combine(self, run: Run) -> Files | None:
        """Join the sources, in the order of the configuration, and see what their experts return elsewhere."""
        if not run.config.demonstrations.sources:
            return None
        parts = [CollectedDemonstrations.load(run.job_artifact(self.name, job)) for job in self.jobs(run)]
        joined = Demonstrations.joined([part.demonstrations for part in parts])
        kept_share = tuple(share for part in parts for share in part.kept_share)
        environment = run.config.environment.id
        return CollectedDemonstrations(joined, kept_share, environment, transfer_returns(run.config)).files()


def load_demonstrations(run: Run) -> Demonstrations:
    """Return the demonstrations of a run whose first stage is finished, under the labels of its configuration."""
    held = CollectedDemonstrations.load(run.artifact(DemonstrationsStage.name)).demonstrations
    section = run.config.demonstrations
    labels = tuple(source.label for source in section.sources) or section.labels
    # A run that is continued comes first, with labels of its own.
    earlier = held.source_labels[: len(held.source_labels) - len(labels)]
    return replace(held, source_labels=earlier + labels) if labels else held


def transferable_marks(config: RunConfig, labels: tuple[str, ...]) -> list[bool | None]:
    """Return whether each source, by its label, is marked transferable; None where nothing is said of it.

    Sources that a run which is continued knows by their label have its marks.
    """
    section, base = config.demonstrations, base_run(config)
    known = {source.label: source.transferable for source in section.sources}
    if base is not None:
        before = load_demonstrations(base).source_labels
        known |= zip(before, transferable_marks(base.config, before), strict=True)
    known |= dict.fromkeys(section.transferable, True) | dict.fromkeys(section.unmarked)
    return [known.get(label, False if section.transferable else None) for label in labels]


def check_expert(section: ExpertConfig, environment: EnvironmentConfig, observation_dim: int) -> None:
    """Raise DataError or ExpertError if a demonstrator is not there or cannot act in the environment."""
    if section.expert_folder is None:
        hand_written(make_batch(environment.id, environment.dynamics, 1), environment.id)
        return
    policy, _ = load_expert(section.expert_folder)
    if len(policy.input_mean) != observation_dim:
        raise DataError(
            f"{section.expert}: the expert sees {len(policy.input_mean)} dimensions; "
            f"environment {environment.id} has {observation_dim}"
        )


def _say_what_is_raw(config: RunConfig, context: JobContext) -> None:
    """Warn of actions that have no bounds by which they could be scaled."""
    environment = config.environment
    low, high = environment_spec(environment.id, environment.dynamics).bounds()
    raw = np.flatnonzero((low != -1) | (high != 1)).tolist()
    if raw:
        context.warn(
            f"environment {environment.id!r} has no finite bounds for {'actions' if len(raw) > 1 else 'action'} "
            f"{', '.join(map(str, raw))}: learned as they are, from a spread of 1, where others are scaled to [-1, 1]"
        )


def _check_count(config: RunConfig, count: int, origin: str | Path) -> None:
    """Raise DataError when there are fewer demonstrations than clusters; a run that is continued has its clusters."""
    if config.finetuning.run is None and count < config.clustering.num_clusters:
        raise DataError(
            f"{origin}: {count} demonstrations cannot form {config.clustering.num_clusters} clusters; give more, or a "
            "smaller clustering.num_clusters"
        )


def _check_labels(config: RunConfig, demonstrations: Demonstrations) -> None:
    """Raise DataError for labels and marks that are not those of the file's sources."""
    section, held = config.demonstrations, demonstrations.source_labels
    if section.labels and len(section.labels) != len(held):
        raise DataError(
            f"{section.file}: has {len(held)} sources ({', '.join(held)}), but there are {len(section.labels)} labels"
        )
    known = section.labels or held
    for label in (*section.transferable, *section.unmarked):
        if label not in known:
            raise DataError(f"{section.file}: has no source {label!r}, only {', '.join(known)}")


def hand_written(simulators: Simulators, env_id: str) -> Controller:
    """Return the controller that an environment brings along. Raises ExpertError if it brings none."""
    if not hasattr(simulators, "demonstrator"):
        raise ExpertError(f"{env_id} brings no hand-written controller; name the folder of a saved expert")
    controller: Controller = simulators.demonstrator()
    return controller


def collect_demonstrations(
    policy: GaussianPolicy | None,
    environment: EnvironmentConfig,
    source: int | str,
    count: int,
    seed: int,
    *,
    deterministic: bool,
    full_length_only: bool,
    minimum_return: float | None,
    context: JobContext,
) -> tuple[Demonstrations, float]:
    """Collect ``count`` demonstrations and return them with the share of episodes that were kept.

    The ``source``, a number for those of a mixture, and the ``seed`` name the random stream; what the source is called
    in reports does not matter.
    Without a policy, the environment's hand-written controller acts; it does as it does, ``deterministic`` or not.

    Raises DataError when fewer than one episode in ten can be kept.
    """
    simulators = make_batch(environment.id, environment.dynamics, COLLECTION_SIMULATORS)
    controller = policy or hand_written(simulators, environment.id)
    kept: list[Episode] = []
    rounds = 0
    while len(kept) < count:
        rounds += 1
        key = derive_key(seed, "demonstrations", source, rounds)
        stochastic = policy is not None and not deterministic
        episodes = run_episodes(simulators, controller, numpy_rng(key), stochastic=stochastic)
        if full_length_only:
            episodes = [each for each in episodes if len(each.states) == simulators.max_episode_steps + 1]
        if minimum_return is not None:
            episodes = [replace(each, terminated=False) for each in episodes if each.env_return >= minimum_return]
        kept += episodes
        if len(kept) * 10 < rounds * COLLECTION_SIMULATORS:
            raise DataError(
                f"only {len(kept)} of {rounds * COLLECTION_SIMULATORS} episodes can be kept "
                f"(full_length_only: {full_length_only}, minimum_return: {minimum_return}); train a better expert or "
                "ask for less"
            )
        context.progress(min(len(kept), count), count)
    share = len(kept) / (rounds * COLLECTION_SIMULATORS)
    return Demonstrations.of(kept[:count], f"source {source}"), share


def flags(section: DemonstrationsConfig) -> dict[str, Any]:
    """Return which episodes are collected, and which of them are kept."""
    return section.model_dump(include={"deterministic", "full_length_only", "minimum_return"})


def identity(section: ExpertConfig) -> str:
    """Return what an expert is, whatever its folder is called."""
    return load_expert(section.expert_folder)[1].sha256 if section.expert_folder else str(section.expert)


register(DemonstrationsStage())
