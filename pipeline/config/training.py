"""How policies are trained: on-policy reinforcement and adversarial imitation."""

from typing import Annotated, Any, Literal

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from oodil.pipeline.config.sections import Hidden, Section, UnitInterval


class TrpoConfig(Section):
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


class PpoConfig(Section):
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


class ValueConfig(Section):
    """The value function and its regression."""

    hidden: Hidden = (64, 64)
    """Widths of the hidden layers."""
    learning_rate: PositiveFloat = 1e-3
    """Adam's step size; 3e-4 in the official code."""
    epochs: PositiveInt = 3
    """Passes over each batch; 1 in the official code."""
    minibatch_size: PositiveInt = 256
    """Transitions per gradient step; the official code cuts each batch into 30."""


class DiscriminatorConfig(Section):
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


class TrainingConfig(Section):
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
    """What the policy's standard deviation shrinks to in the second half of the training, so that mean actions do what
    sampled ones learned; null leaves it alone."""
    least_std: PositiveFloat = 0.4
    """What that deviation does not fall below before it shrinks, with a `final_std`: or exploration would end early."""
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

    @property
    def env_steps(self) -> int:
        """Environment steps of all iterations."""
        return self.num_iterations * self.steps_per_iteration


class GailConfig(TrainingConfig):
    """Adversarial imitation: training whose reward comes from a discriminator."""

    final_std: PositiveFloat | None = 0.1
    """What the policy's standard deviation shrinks to in the second half of the training, so that mean actions do what
    sampled ones learned; null leaves it alone."""
    discriminator: DiscriminatorConfig = DiscriminatorConfig()
    """What tells demonstrations from the policy."""
