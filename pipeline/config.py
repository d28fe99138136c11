"""The configuration: one frozen model, validated once (`oodil.pipeline.loading`), written into the run directory.

Every field has a type, a default where one is sensible, and a line below it. Nothing here imports torch or a simulator.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, model_validator

UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]
Hidden = Annotated[tuple[PositiveInt, ...], Field(min_length=1)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class EnvironmentConfig(_Section):
    """An environment and its dynamics."""

    id: str = "oodil/Hopper-v0"
    """A Gymnasium id that has a batched form."""
    dynamics: dict[str, float] = {}
    """Keyword arguments of the environment: the imitator's own dynamics."""


class TrpoConfig(_Section):
    """Trust region policy optimization; the official constants but for ``fisher_every``."""

    kind: Literal["trpo"] = "trpo"
    max_kl: PositiveFloat = 0.01
    """Size of the trust region, in nats per state."""
    damping: PositiveFloat = 0.1
    """Multiple of the identity added to the Fisher matrix."""
    fisher_every: PositiveInt = 4
    """One state in n, drawn from the batch, enters the Fisher-vector products; 1 is the official code's."""
    cg_iterations: PositiveInt = 10
    """Conjugate gradient iterations per step."""
    cg_tolerance: PositiveFloat = 1e-10
    """Squared residual at which they stop."""
    backtracks: PositiveInt = 10
    """Halvings of the step before it is refused."""
    accept_ratio: UnitInterval = 0.1
    """Share of the expected improvement that a step must reach."""


class PpoConfig(_Section):
    """Proximal policy optimization with the clipped surrogate."""

    kind: Literal["ppo"] = "ppo"
    learning_rate: PositiveFloat = 3e-4
    """Adam's step size."""
    epochs: PositiveInt = 5
    """Passes over each batch."""
    minibatch_size: PositiveInt = 512
    """Transitions per gradient step."""
    clip: PositiveFloat = 0.2
    """Half-width of the ratio's interval."""
    max_grad_norm: PositiveFloat = 0.5
    """Gradients are scaled down to this norm."""
    entropy_bonus: float = 0.0
    """Weight of the policy's entropy."""


class ValueConfig(_Section):
    """The value function and its regression."""

    hidden: Hidden = (64, 64)
    """Widths of the hidden layers."""
    learning_rate: PositiveFloat = 1e-3
    """Adam's step size; 3e-4 in the official code."""
    epochs: PositiveInt = 3
    """Passes over each batch; 1 in the official code."""
    minibatch_size: PositiveInt = 256
    """Transitions per gradient step; the official code cuts each batch into 30."""


class DiscriminatorConfig(_Section):
    """The discriminator and its steps."""

    hidden: Hidden = (64, 64)
    """Widths of the hidden layers."""
    learning_rate: PositiveFloat = 1e-3
    """Adam's step size."""
    steps_per_iteration: PositiveInt = 3
    """Steps after each policy update; each takes its share of the iteration's batch."""
    view: Literal["change", "raw"] = "change"
    """What it sees of a pair: (s, s' - s), each dimension standardized over the demonstrations; or (s, s') as they
    are, the paper's."""
    gradient_penalty: float = Field(default=1.0, ge=0.0)
    """Weight of half the squared gradient of its logit at demonstrations."""


class TrainingConfig(_Section):
    """On-policy training: what is collected per iteration and how the policy learns from it."""

    total_steps: PositiveInt
    """Environment steps; rounded up to whole iterations."""
    num_groups: PositiveInt = 4
    """Env groups, the units of work handed to rollout workers; at most that many workers are busy at once."""
    simulators_per_group: PositiveInt = 8
    """Simulators stepped together in one group."""
    steps_per_rollout: PositiveInt = 80
    """Steps of each simulator per iteration."""
    lag: Literal[0, 1] = 1
    """Policy versions between collection and update; 1 lets workers collect while the learner updates."""
    discount: float = Field(default=0.995, ge=0.0, lt=1.0)
    """Discount per step."""
    gae_lambda: UnitInterval = 0.97
    """Decay of generalized advantage estimation."""
    policy_hidden: Hidden = (64, 64)
    """Widths of the policy's hidden layers."""
    normalize_observations: bool = True
    """Standardize what policy and value see, by the weighted demonstrations' statistics (for experts, by running
    ones)."""
    scale_rewards: bool = False
    """Multiply rewards by 1 - discount, so that values are of order one."""
    anneal: bool = True
    """Let the steps of the policy and of the discriminator shrink linearly to zero, so that the end is settled."""
    initial_log_std: float = 0.0
    """Logarithm of the policy's initial standard deviation."""
    final_std: PositiveFloat | None = None
    """What the policy's standard deviation shrinks to in the second half of the training, and never falls below, so
    that mean actions do what sampled ones learned; null leaves it alone."""
    policy_optimizer: Annotated[TrpoConfig | PpoConfig, Field(discriminator="kind")] = TrpoConfig()
    """How the policy is improved."""
    value: ValueConfig = ValueConfig()
    """The value function."""
    torch_threads: PositiveInt = 1
    """Threads of the learner; more do not help networks of this size, and change the bits."""

    @model_validator(mode="before")
    @classmethod
    def _default_policy_optimizer(cls, values: Any) -> Any:
        # Without a kind the fields are those of the default, so that one of them can be overridden alone.
        if isinstance(values, dict) and isinstance(values.get("policy_optimizer"), dict):
            return values | {"policy_optimizer": {"kind": "trpo"} | values["policy_optimizer"]}
        return values

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps per iteration."""
        return self.num_groups * self.simulators_per_group * self.steps_per_rollout

    @property
    def num_iterations(self) -> int:
        """Iterations that reach ``total_steps``."""
        return -(-self.total_steps // self.steps_per_iteration)


class GailConfig(TrainingConfig):
    """Adversarial imitation: training whose reward comes from a discriminator."""

    final_std: PositiveFloat | None = 0.1
    """What the policy's standard deviation shrinks to in the second half of the training, and never falls below, so
    that mean actions do what sampled ones learned; null leaves it alone."""
    discriminator: DiscriminatorConfig = DiscriminatorConfig()
    """What tells demonstrations from the policy."""


class SourceConfig(_Section):
    """One demonstrator: its dynamics, its expert and how many of its demonstrations are used."""

    label: str
    """Its name in reports."""
    dynamics: dict[str, float] = {}
    """Keyword arguments of the environment: the demonstrator's own dynamics."""
    expert: Literal["hand-written"] | Path
    """Folder of a saved expert, relative to the configuration file, or the controller that the environment brings."""
    expert_discount: UnitInterval = 0.995
    """Discount with which its expert is trained; flights are long under low gravity and want a longer horizon."""
    count: PositiveInt
    """Demonstrations to collect."""
    transferable: bool | None = None
    """Whether the imitator can reproduce it, if known: for the report and the oracle, never an input of the method."""

    @property
    def expert_folder(self) -> Path | None:
        """The folder of a saved expert; None for a hand-written controller."""
        return self.expert if isinstance(self.expert, Path) else None


class DemonstrationsConfig(_Section):
    """Where the demonstrations come from: a file, or saved experts."""

    file: Path | None = None
    """A saved set, relative to the configuration file."""
    sources: tuple[SourceConfig, ...] = ()
    """Demonstrators to collect from."""
    deterministic: bool = False
    """Collect with mean actions instead of sampled ones."""
    full_length_only: bool = True
    """Keep only episodes that last to the time limit, as the paper does."""
    minimum_return: float | None = None
    """Keep only episodes with at least this true return in the demonstrator's own environment. However it ended, such
    an episode has not failed."""

    @model_validator(mode="after")
    def _one_origin(self) -> "DemonstrationsConfig":
        if (self.file is None) == (not self.sources):
            raise ValueError("give either file or sources")
        labels = [source.label for source in self.sources]
        if len(set(labels)) != len(labels):
            raise ValueError(f"two sources have the same label: {labels}")
        return self


class ClusteringConfig(_Section):
    """Contrastive clustering, Algorithm 1, or k-means. ``preset: paper`` gives the appendix's constants, ``preset:
    official`` the released code's (docs/presets.md); the defaults differ where docs/decisions.md says why."""

    features: Literal["contrastive", "states"] = "contrastive"
    """What is clustered: features that an encoder learns, or the standardized states of one sub-trajectory of each
    demonstration, by k-means, which trains nothing (appendix C.6)."""
    num_clusters: PositiveInt = 5
    """K at initialization; clusters may end up empty. With 1 there is nothing to train."""
    subtrajectory_length: int = Field(default=20, ge=2)
    """States per sub-trajectory."""
    sampling: Literal["fixed_length", "fixed_stride"] = "fixed_length"
    """Whether ``subtrajectory_length`` counts states (appendix) or is the stride between them (official code)."""
    hidden: PositiveInt = 128
    """Width of the LSTM, and of the embedding."""
    temperature: PositiveFloat = 1.0
    """Divides the cosine similarities."""
    center_weight: float = Field(default=0.01, ge=0.0)
    """Lambda: weight of the distance to the centers."""
    reduction: Literal["sum", "mean"] = "sum"
    """How that distance is reduced over the 2B sub-trajectories of a batch."""
    learning_rate: PositiveFloat = 1e-3
    """Adam's step size."""
    weight_decay: float = Field(default=0.0, ge=0.0)
    """Adam's weight decay."""
    warmup_iterations: int = Field(default=200, ge=0)
    """Iterations with the contrastive loss alone."""
    sufficient_stability: UnitInterval | None = 0.9
    """The warm-up is left out if, before any training, this share of single sub-trajectories falls into the cluster of
    their demonstration; null never leaves it out."""
    joint_iterations: int = Field(default=300, ge=0)
    """Iterations with both losses."""
    batch_size: PositiveInt = 128
    """Demonstrations per iteration; all of them if there are fewer."""
    initial_centers: Literal["trajectories", "kmeans"] = "kmeans"
    """K random demonstrations (appendix) or k-means of all (official code)."""
    initial_count: PositiveInt = 100
    """Counter at which each center's running mean starts."""
    update_order: Literal["step_first", "centers_first"] = "step_first"
    """Gradient step, re-assign, then centers (appendix), or centers before the step (official code)."""
    normalize_centers: bool = True
    """Keep centers on the unit sphere."""
    standardize_states: bool = True
    """Standardize each state dimension over the set."""
    label_draws: PositiveInt = 5
    """Sub-trajectories of each demonstration whose features are averaged, for k-means and for the final label."""

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, values: Any) -> Any:
        if isinstance(values, dict) and "preset" in values:
            if not isinstance(values["preset"], str) or values["preset"] not in CLUSTERING_PRESETS:
                raise ValueError(f"preset is {values['preset']!r}; there are {', '.join(CLUSTERING_PRESETS)}")
            preset = CLUSTERING_PRESETS[values["preset"]]
            return preset | {key: value for key, value in values.items() if key != "preset"}
        return values


CLUSTERING_PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "learning_rate": 0.01,
        "sufficient_stability": None,
        "joint_iterations": 2000,
        "reduction": "mean",
        "initial_centers": "trajectories",
        "normalize_centers": False,
        "label_draws": 1,
    },
    "official": {
        "sampling": "fixed_stride",
        "weight_decay": 1e-6,
        "sufficient_stability": None,
        "joint_iterations": 1800,
        "update_order": "centers_first",
        "normalize_centers": False,
        "standardize_states": False,
        "label_draws": 1,
    },
}
"""What ``clustering.preset`` can stand for: the constants of the appendix, or the released code's reading."""


class ReadingConfig(_Section):
    """How it is read what an imitator reproduces: by fresh discriminators, trained on halves of demonstrations and
    episodes, that read the other halves, or by its own discriminator. All fields but the first are of fresh ones."""

    discriminator: Literal["fresh", "last"] = "fresh"
    """Who reads: fresh discriminators, or the one that the imitator was trained against, as it stood last (the paper's
    Eqn 6). The latter says nothing of its error: its intervals have no width."""
    steps: PositiveInt = 600
    """Steps of each discriminator."""
    learning_rate: PositiveFloat = 3e-3
    """Adam's step size."""
    gradient_penalty: float = Field(default=3.0, ge=0.0)
    """Weight of half the squared gradient, as in training; a flatter judge tells broad differences from small ones."""
    batch_size: PositiveInt = 512
    """Transitions from either side in a step."""
    repetitions: PositiveInt = 4
    """Times that other halves are drawn, two discriminators each."""

    @property
    def num_readers(self) -> int:
        """Discriminators that read a demonstration of which they have seen nothing."""
        return 2 * self.repetitions if self.discriminator == "fresh" else 1


class TransferabilityConfig(_Section):
    """One GAIL job per cluster, and how its discriminators are read."""

    gail: GailConfig
    """Training of each job. ``anneal`` is off unless it is set: a discriminator that stops learning is fooled in the
    end, and the scores of what cannot be reproduced rise."""
    reading: ReadingConfig = ReadingConfig()
    """How the finished imitators are read."""
    num_trainings: PositiveInt = 1
    """Trainings of each cluster's imitator, each with a seed of its own; the one whose transitions come closest to the
    cluster's counts."""
    kept_from: UnitInterval = 0.5
    """A demonstration is kept if its score is at least this share of the best cluster's; with 0 everything is kept, and
    weighs in proportion to its score (the paper's Eqn 7)."""

    @model_validator(mode="before")
    @classmethod
    def _constant_steps(cls, values: Any) -> Any:
        if isinstance(values, dict) and isinstance(values.get("gail"), dict):
            return values | {"gail": {"anneal": False} | values["gail"]}
        return values


class ReproducibilityConfig(_Section):
    """How closely the imitator's simulator can follow the demonstrations, by physics and without learning. Nothing
    else depends on it but the policy `exact_id`. The environment has to be one that can be put into an observed
    state."""

    transitions: PositiveInt = 8
    """Trials of each demonstration."""
    horizon: PositiveInt = 4
    """Steps that a trial follows it."""
    iterations: PositiveInt = 4
    """Gauss-Newton steps with which each action is sought."""


class FeasibilityConfig(_Section):
    """The competing method f-MDP: policies that track demonstrations and learn as the imitators of clusters do, with as
    many environment steps in all."""

    discount: float = Field(default=0.9, gt=0.0, le=1.0)
    """By which each further step of a demonstration counts less."""
    steps_per_iteration: PositiveInt = 15_000
    """Environment steps of an update, rounded up to whole episodes of the longest demonstration."""
    alpha: PositiveFloat | None = None
    """The difference of two distances that divides feasibility by e, in units of the observations; the released code
    has 5 for locomotion. Null: distances are in deviations over the demonstrations, and their own spread decides."""


class InverseDynamicsConfig(_Section):
    """The competing method ID, behind the policies `id_random` and `id_gail`: an inverse model, learned from
    exploration, follows each demonstration in the imitator's simulator. The environment has to be one that can be put
    into an observed state."""

    transitions: PositiveInt = 100_000
    """Of exploration; rounded up to whole rollouts."""
    held_out: float = Field(default=0.1, gt=0.0, lt=1.0)
    """Share of them, in whole episodes, that the model does not learn from: how far it stays behind these is what
    demonstrations are measured by."""
    hidden: PositiveInt = 100
    """Width of the network."""
    blocks: PositiveInt = 6
    """Residual blocks."""
    learning_rate: PositiveFloat = 0.01
    """Adam's step size."""
    batch_size: PositiveInt = 128
    """Transitions per gradient step."""
    passes: PositiveInt = 10
    """Over the transitions that the model learns from."""


class ImitationConfig(_Section):
    """The final policy, and every baseline."""

    gail: GailConfig
    """Each training."""
    num_trainings: PositiveInt = 2
    """Trainings, each with a seed of its own; the policy whose transitions come closest to the weighted demonstrations'
    is kept. They run side by side where there are no more workers than trainings."""


class FinetuningConfig(_Section):
    """How `oodil finetune` goes on from the policy of a finished run, on its demonstrations and later ones. What is not
    here is as in `imitation`."""

    run: Path | None = None
    """Folder of the run that is continued, set by the command. A run with it has the stages of a fine-tuning alone, and
    `demonstrations.file` holds the later demonstrations."""
    weighting: str = "transferability"
    """Weighting of that run by which the later demonstrations are scored."""
    total_steps: PositiveInt | None = None
    """Environment steps of each training; null for a quarter of `imitation.gail.total_steps`."""
    initial_std: PositiveFloat = 0.3
    """What the policy's standard deviation is set to at the beginning; it shrinks again to `imitation.gail.final_std`,
    which it must not be below."""


class EvaluationConfig(_Section):
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


class RuntimeConfig(_Section):
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
        "imitation": {"gail": _PAPER_GAIL, "num_trainings": 1},
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


class RunConfig(_Section):
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
    imitation: ImitationConfig
    """The final policy."""
    finetuning: FinetuningConfig = FinetuningConfig()
    """A continuation of a finished run."""
    baselines: tuple[str, ...] = ()
    """Policies that are trained beside it for comparison: `naive_gail`, `naive_gail_all_steps`, `oracle`, `f_mdp`,
    `f_mdp_per_source`, `id_random`, `id_gail`, `exact_id`, or `module:name` for one that another module registers."""
    evaluation: EvaluationConfig = EvaluationConfig()
    """What is measured beside the training."""
    runtime: RuntimeConfig = RuntimeConfig()
    """How it runs."""

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
