"""A fine-tuning: a finished run's policy goes on learning, from its demonstrations and from ones that came later.

It is a run of its own, whose `finetuning.run` names the one that it continues. Its demonstrations are those of that run
and then the later ones; its stages here weigh them by a frozen weighting of that run, and train.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from oodil.pipeline.artifacts import Artifact, Files
from oodil.pipeline.config import GailConfig, RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.results import Policy, Transferability, load_value
from oodil.pipeline.stage import JobContext, Run, base_run, register
from oodil.pipeline.stages.demonstrations import load_demonstrations
from oodil.pipeline.stages.policies import PolicyStage, refuse_other_widths
from oodil.pipeline.stages.weighting import Weighting

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.gail import AdversarialReward
    from oodil.pipeline.algorithms.learner import Learner

SHARE_OF_STEPS = 4
"""One in so many steps of a policy's training is what a fine-tuning takes unless its configuration says otherwise."""


class LaterScoresStage(Weighting):
    """A weighting of the run that is continued, frozen: what it said of its demonstrations, and says of later ones."""

    name = "later_scores"
    title = "frozen weighting"
    version = 1
    inputs = ("demonstrations",)

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return which weighting it is, and the content of its artifact."""
        base, frozen = _frozen(config)
        return {"weighting": frozen.name, "base": base.artifact(frozen.name).sha256}

    def rule(self, config: RunConfig) -> str:
        """Say what the frozen weighting does."""
        base, frozen = _frozen(config)
        return frozen.rule(base.config)

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Score the later demonstrations, and weigh all of them together."""
        import torch
        from threadpoolctl import threadpool_limits

        torch.set_num_threads(1)
        base, frozen = _frozen(run.config)
        known, demonstrations = frozen.load(base), load_demonstrations(run)
        with threadpool_limits(1):
            later = frozen.score(base, demonstrations.select(np.arange(len(known.scores), len(demonstrations))))
        parts: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in (known, later)])
            for name in ("scores", "weights", "clusters", "intervals")
        }
        found = Transferability(**parts, threshold=known.threshold)
        return replace(found, weights=frozen.weights(found)).files()

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        """Return what the frozen weighting says."""
        base, frozen = _frozen(run.config)
        return frozen.score(base, demonstrations)


class FinetuningStage(PolicyStage):
    """Goes on from the final policy and its value function, with noise set anew and a fresh discriminator."""

    version = 4

    def job_settings(self, config: RunConfig) -> dict[str, Any]:
        """Return what a training depends on, the policy it begins with included."""
        own = {"base": _policy(config).sha256, "initial_std": config.finetuning.initial_std}
        return super().job_settings(config) | own

    def check(self, config: RunConfig) -> None:
        """Refuse noise that could not shrink, and networks of other widths than those that are continued."""
        gail, std = config.imitation.gail, config.finetuning.initial_std
        if gail.final_std is not None and std < gail.final_std:
            raise ConfigError(
                f"finetuning.initial_std is {std:g}; it must reach imitation.gail.final_std {gail.final_std:g}"
            )
        refuse_other_widths("the policy that is continued", _base(config).config.imitation.gail, gail)

    def gail(self, config: RunConfig) -> GailConfig:
        """Return how each training is done: as the policy's was, for a part of its steps."""
        gail = config.imitation.gail
        steps = config.finetuning.total_steps or max(1, gail.total_steps // SHARE_OF_STEPS)
        return gail.model_copy(update={"total_steps": steps})

    def begin(self, run: Run, job: str, learner: "Learner[AdversarialReward]") -> tuple[bool, int]:
        """Take over policy and value function, with the noise that is asked for."""
        trained = _policy(run.config)
        learner.continue_from(Policy.load(trained).gaussian, load_value(trained), run.config.finetuning.initial_std)
        return True, 0


def _base(config: RunConfig) -> Run:
    base = base_run(config)
    if base is None:
        raise ConfigError("finetuning.run: required, but missing; `oodil finetune` sets it")
    return base


def _frozen(config: RunConfig) -> tuple[Run, Weighting]:
    """Return the run that is continued and its weighting that counts."""
    from oodil.pipeline.stages import weightings_of

    base = _base(config)
    known = {each.name: each for each in weightings_of(base.config)}
    if config.finetuning.weighting not in known:
        raise ConfigError(f"finetuning.weighting: no {config.finetuning.weighting!r}; there are {', '.join(known)}")
    return base, known[config.finetuning.weighting]


def _policy(config: RunConfig) -> Artifact:
    """Return the final policy of the run that is continued."""
    from oodil.pipeline.stages import policies_of

    base = _base(config)
    return base.artifact(policies_of(base.config)[0].name)


register(LaterScoresStage())
register(FinetuningStage("finetuning", title="fine-tuned", weighting="later_scores"))
