"""The configuration of a whole run, and the presets of it."""

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PositiveFloat, PositiveInt, ValidationInfo, field_validator, model_validator

from oodil.pipeline.config.clustering import CLUSTERING_PRESETS, ClusteringConfig
from oodil.pipeline.config.demonstrations import DemonstrationsConfig, ExpertConfig
from oodil.pipeline.config.methods import (
    FeasibilityConfig,
    FinetuningConfig,
    ImitationConfig,
    InverseDynamicsConfig,
    ReproducibilityConfig,
    TransferabilityConfig,
)
from oodil.pipeline.config.sections import EnvironmentConfig, Section, dynamics_of


class EvaluationConfig(Section):
    """What is measured beside the training. Nothing here changes a policy or a score, so nothing is part of a
    fingerprint: a finished training keeps the measurements that it was made with."""

    num_points: int = Field(default=12, ge=0)
    """Points of a policy's learning curve, each the mean action on fresh episodes."""
    episodes: PositiveInt = 8
    """Episodes per point of the curve."""
    final_episodes: PositiveInt = 32
    """Episodes of the final evaluation; `oodil evaluate` runs more of a finished policy."""
    num_scores: int = Field(default=20, ge=2)
    """Times the demonstrations of a cluster are scored while its imitator is trained, for the report."""


class RuntimeConfig(Section):
    """How it runs. Nothing here changes a result, so nothing here is part of a fingerprint."""

    workers: int = Field(default=2, ge=0)
    """Parallel processes; 0 runs everything in the orchestrator's own."""
    checkpoint_interval_s: float = Field(default=20.0, ge=0.0)
    """Seconds between checkpoints of a job; 0 checkpoints every iteration."""
    unit_timeout_s: PositiveFloat = 30.0
    """Seconds after which a unit of work is given to another rollout worker."""
    job_timeout_s: PositiveFloat = 600.0
    """Seconds without any progress after which a job counts as hung, is killed and started again."""
    max_attempts: PositiveInt = 3
    """Attempts at a job, in a row, that get no further than one before, until it counts as failed."""
    max_worker_restarts: PositiveInt = 20
    """Restarts of rollout workers in one stage before it counts as failed."""
    restart_delay_s: float = Field(default=0.5, ge=0.0)
    """Pause before the first restart; it doubles with each further one, up to 10 s."""
    modules: Path | None = None
    """Folder of the modules that `environment.id` and `baselines` name, where they are not installed; that of the
    configuration file unless something else is said, and relative to it."""
    logger: Literal["wandb", "trackio"] | None = None
    """Also shows what jobs report there, on this machine alone unless WANDB_MODE or trackio's own variables say
    otherwise; each job logs from its own process (docs/operations.md)."""


_PAPER_GAIL: dict[str, Any] = {
    "lag": 0,
    "normalize_observations": False,
    "anneal": False,
    "final_std": None,
    "policy_optimizer": {"kind": "trpo", "fisher_every": 1},
    "value": {"learning_rate": 3e-4, "epochs": 1, "minibatch_size": 86},  # 30 steps per iteration
    "discriminator": {"steps_per_iteration": 1, "view": "raw", "gradient_penalty": 0.0},
}
"""Constants of every imitation. The appendix gives none, so both presets have the released code's."""

PRESETS: dict[str, dict[str, Any]] = {
    name: {
        "clustering": {"preset": name},
        "transferability": {"gail": _PAPER_GAIL, "reading": {"discriminator": "last"}, "kept_from": 0.0},
        "imitation": {"gail": _PAPER_GAIL, "num_trainings": 1, "num_candidates": 1, "warm_start": False},
    }
    for name in CLUSTERING_PRESETS
}
"""What ``preset`` can stand for (docs/presets.md). What differs by environment is left to the configuration."""


def _filled_in(values: Any, defaults: dict[str, Any]) -> Any:
    """Return values with defaults, also those of their sections; one of another kind gets none."""
    if not isinstance(values, dict) or values.get("kind", defaults.get("kind")) != defaults.get("kind"):
        return values
    return values | {
        key: _filled_in(values.get(key, {}), default) if isinstance(default, dict) else values.get(key, default)
        for key, default in defaults.items()
    }


class RunConfig(Section):
    """One run: demonstrations, clusters, transferability, policy."""

    preset: Literal["paper", "official"] | None = None
    """Constants of the whole run where nothing else is said: the appendix's, or the released code's (docs/presets.md);
    null for ours."""
    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    """Name of the run and of its default folder."""
    seed: int = Field(default=0, ge=0)
    """Root of all randomness."""
    environment: EnvironmentConfig
    """The imitator's environment."""
    demonstrations: DemonstrationsConfig
    """What is imitated."""
    clustering: ClusteringConfig = ClusteringConfig()
    """Modes of the demonstrations."""
    transferability: TransferabilityConfig
    """What the imitator can reproduce."""
    reproducibility: ReproducibilityConfig | None = None
    """A physical check of the demonstrations, beside the method; without this section there is none, unless `exact_id`
    asks for it."""
    f_mdp: FeasibilityConfig = FeasibilityConfig()
    """How the baselines `f_mdp` and `f_mdp_per_source` weigh demonstrations."""
    inverse_dynamics: InverseDynamicsConfig = InverseDynamicsConfig()
    """The competing method ID, for runs that have `id_random` or `id_gail` among their baselines."""
    oracle_target: ExpertConfig | None = None
    """An expert of the imitator's own dynamics, for runs that have `oracle_target` among their baselines. Its
    demonstrations are collected as those of `demonstrations.sources` are, and never mixed with them."""
    imitation: ImitationConfig
    """The final policy."""
    finetuning: FinetuningConfig = FinetuningConfig()
    """A continuation of a finished run."""
    baselines: tuple[str, ...] = ()
    """Policies that are trained beside it for comparison: `naive_gail`, `naive_gail_all_steps`, `oracle`,
    `oracle_target`, `f_mdp`, `f_mdp_per_source`, `id_random`, `id_gail`, `exact_id`, or `module:name` for one that
    another module registers."""
    evaluation: EvaluationConfig = EvaluationConfig()
    """What is measured beside the training."""
    runtime: RuntimeConfig = RuntimeConfig()
    """How it runs."""

    @field_validator("demonstrations")
    @classmethod
    def _dynamics_as_given(cls, section: DemonstrationsConfig, info: ValidationInfo) -> DemonstrationsConfig:
        environment: EnvironmentConfig | None = info.data.get("environment")
        if environment is None:
            return section
        sources = [
            each.model_copy(update={"dynamics": dynamics_of(environment.id, each.dynamics)}) for each in section.sources
        ]
        return section.model_copy(update={"sources": tuple(sources)})

    @property
    def cluster_steps(self) -> int:
        """Environment steps of the imitators of all clusters together."""
        section = self.transferability
        return self.clustering.num_clusters * section.num_trainings * section.gail.total_steps

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, values: Any) -> Any:
        if isinstance(values, dict) and isinstance(values.get("preset"), str) and values["preset"] in PRESETS:
            return _filled_in(values, PRESETS[values["preset"]])
        return values
