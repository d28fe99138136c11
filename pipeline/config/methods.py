"""How demonstrations are weighed, and policies trained with the weights: the method and the competing ones."""

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from oodil.pipeline.config.sections import Section, UnitInterval
from oodil.pipeline.config.training import GailConfig


class ReadingConfig(Section):
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


class TransferabilityConfig(Section):
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
    """A demonstration is kept if its score is at least this share of the best mode's: of the mean over those of a
    cluster that reach the same share of its highest. With 0 everything is kept, and weighs in proportion to its score
    (the paper's Eqn 7)."""

    @model_validator(mode="before")
    @classmethod
    def _constant_steps(cls, values: Any) -> Any:
        if isinstance(values, dict) and isinstance(values.get("gail"), dict):
            return values | {"gail": {"anneal": False} | values["gail"]}
        return values


class ReproducibilityConfig(Section):
    """How closely the imitator's simulator can follow the demonstrations, by physics and without learning. Nothing
    else depends on it but the policy `exact_id`. The environment has to be one that can be put into an observed
    state."""

    transitions: PositiveInt = 8
    """Trials of each demonstration."""
    horizon: PositiveInt = 4
    """Steps that a trial follows it."""
    iterations: PositiveInt = 4
    """Gauss-Newton steps with which each action is sought."""


class FeasibilityConfig(Section):
    """The competing method f-MDP: policies that track demonstrations and learn as the imitators of clusters do, with as
    many environment steps in all."""

    discount: float = Field(default=0.9, gt=0.0, le=1.0)
    """By which each further step of a demonstration counts less."""
    steps_per_iteration: PositiveInt = 15_000
    """Environment steps of an update, rounded up to whole episodes of the longest demonstration."""
    alpha: PositiveFloat | None = None
    """The difference of two distances that divides feasibility by e, in units of the observations; the released code
    has 5 for locomotion. Null: distances are in deviations over the demonstrations, and their own spread decides."""


class InverseDynamicsConfig(Section):
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


class ImitationConfig(Section):
    """The final policy, and every baseline."""

    gail: GailConfig
    """Each training."""
    num_trainings: PositiveInt = 2
    """Trainings, each with a seed of its own; the policy whose transitions come closest to the weighted demonstrations'
    is kept. They run side by side where there are no more workers than trainings."""
    num_candidates: PositiveInt = 8
    """Points in the second half of a training at which its mean actions are compared with the weighted demonstrations;
    the last of the closest is what the training gives. With 1 it is the end, as in the paper."""
    warm_start: bool = True
    """Whether our policy goes on from the imitator of the cluster that it learns most from, with a standard deviation
    of `least_std`, in every training but each second one. Those begin anew, as baselines do, and as in the paper."""


class FinetuningConfig(Section):
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
