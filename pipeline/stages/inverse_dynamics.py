"""The weightings of a competing method, ID: a demonstration counts as much as an inverse model can follow it.

The model is learned from exploration in the imitator's environment, which `inverse_dynamics_random` does with an
untrained policy and `inverse_dynamics_gail` with the policy of naive GAIL. `exact_inverse_dynamics` has no model: it
takes the residuals of the physical check, which is what a model that errs in nothing would leave.

Letters: N demonstrations, S observation, A action.
"""

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.algorithms.weights import kept_weights
from oodil.pipeline.artifacts import Checkpoints, Files, below, nested
from oodil.pipeline.config import RunConfig, TrainingConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.environments import EnvironmentSpec, environment_spec, make_batch, unplaceable
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.following import ModelFollower
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.results import Following, Policy, Reproducibility, Transferability
from oodil.pipeline.seeding import derive_key, torch_seed
from oodil.pipeline.stage import Cost, JobContext, JobStoppedError, Run, register
from oodil.pipeline.stages.demonstrations import load_demonstrations
from oodil.pipeline.stages.reproducibility import ReproducibilityStage, follow, section_of
from oodil.pipeline.stages.weighting import Weighting

if TYPE_CHECKING:
    from oodil.pipeline.algorithms.inverse_dynamics import Exploration, InverseModel

ABOVE_NOTHING = float(np.nextafter(0.0, 1.0))
"""The least score that says a demonstration can be followed in part; with a score of 0 it weighs nothing."""
SIMULATORS = 32
"""Demonstrations that are followed side by side. No result depends on it."""


class InverseDynamics(Weighting):
    """ID. Its one job explores, learns the model and follows every demonstration; its artifact has a `Following`, too.

    A checkpoint follows every pass over the exploration and every few demonstrations. What is learned from is collected
    again after a stop, to the same bits.
    """

    version = 2

    def __init__(self, name: str, title: str, explorer: str | None) -> None:
        """Name a weighting.

        Args:
            name: of the stage.
            title: what it is called in tables and figures.
            explorer: the policy whose sampled actions explore; without one it is an untrained policy.
        """
        self.name = name
        self.title = title
        self.explorer = explorer
        self.inputs = ("demonstrations",) if explorer is None else ("demonstrations", explorer)

    def check(self, config: RunConfig) -> None:
        """Raise ConfigError for an environment that cannot be put into a state."""
        env_id, dynamics = config.environment.id, config.environment.dynamics
        if not environment_spec(env_id, dynamics).can_be_placed:
            raise ConfigError(f"baselines: {self.title} follows demonstrations; {unplaceable(env_id)}")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return the imitator's environment, and how it is explored and learned from."""
        return config.inverse_dynamics.model_dump() | {"environment": config.environment.settings()}

    def cost(self, config: RunConfig) -> Cost:
        """Return the cost of exploration; what the model and the demonstrations take comes on top."""
        how = _exploration(config)
        return Cost(how.env_steps)

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Explore, learn the model, follow what was held out and every demonstration, and turn errors into scores."""
        import torch

        from oodil.pipeline.algorithms.inverse_dynamics import error_bounds

        torch.set_num_threads(1)
        config, demonstrations = run.config, load_demonstrations(run)
        explored = self._explore(run, context)
        both = Demonstrations.joined([explored.held_out, demonstrations])
        num_held_out, passes = len(explored.held_out), config.inverse_dynamics.passes
        turns = range(0, len(both), SIMULATORS)
        model, errors = self._model(config), np.full(len(both), np.nan)
        pace = _Pace(self.checkpoints(run, job), context, model, errors, passes + len(turns))
        for number in range(pace.done, passes):
            loss = model.learn(explored, number)
            pace.advance(loss=loss)
        follower = _follower(config, model)
        for first in turns[pace.done - passes :]:
            chosen = np.arange(first, min(first + SIMULATORS, len(both)))
            errors[chosen] = follower.errors(both.select(chosen))
            pace.advance()
        held_out, own = np.split(errors, [num_held_out])
        found = Following(own, *error_bounds(own, held_out), model.arrays())
        steps = _exploration(config).env_steps
        return judged(found, own, steps + int((both.lengths - 1).sum())).files() | found.files()

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        """Follow other demonstrations with the run's model, and judge them by the run's bounds."""
        found, model = Following.load(run.artifact(self.name)), self._model(run.config)
        model.load(found.model)
        errors = _follower(run.config, model).errors(demonstrations)
        return judged(found, errors, int((demonstrations.lengths - 1).sum()))

    def _model(self, config: RunConfig) -> "InverseModel":
        """Return the untrained model, the same for every explorer."""
        from oodil.pipeline.algorithms.inverse_dynamics import InverseModel

        spec = environment_spec(config.environment.id, config.environment.dynamics)
        key = derive_key(config.seed, "inverse_dynamics")
        return InverseModel(spec.observation_dim, spec.action_dim, config.inverse_dynamics, key)

    def _explore(self, run: Run, context: JobContext) -> "Exploration":
        """Collect what is learned from and what is held out."""
        from oodil.pipeline.algorithms.inverse_dynamics import Exploration
        from oodil.pipeline.training import experience

        config = run.config
        how, spec = _exploration(config), environment_spec(config.environment.id, config.environment.dynamics)
        policy = (
            _untrained(config, spec) if self.explorer is None else Policy.load(run.artifact(self.explorer)).gaussian
        )
        key = derive_key(config.seed, "inverse_dynamics", "exploration")
        num_steps = how.num_iterations * how.steps_per_rollout
        batch = experience(policy, config.environment, how, num_steps, torch_seed(key), context)
        return Exploration.of(batch, spec.bounds(), config.inverse_dynamics.held_out, key)


class _Pace:
    """Where the job stands: its checkpoints and its progress, in passes and then in turns of the simulators."""

    def __init__(
        self,
        checkpoints: Checkpoints,
        context: JobContext,
        model: "InverseModel",
        errors: NDArray[np.float64],
        total: int,
    ) -> None:
        """Take ``model`` and ``errors`` to where the newest checkpoint has them."""
        self.done = 0
        self._checkpoints, self._context = checkpoints, context
        self._model, self._errors, self._total = model, errors, total
        self._saved_at = time.monotonic()
        arrays, warnings = checkpoints.load()
        for warning in warnings:
            context.warn(warning)
        if arrays is not None:
            self.done = int(arrays["done"])
            errors[:] = arrays["errors"]
            model.load(below("model", arrays))
            model.load_moments(below("moments", arrays))

    def advance(self, **metrics: float) -> None:
        """Count one more. Raises JobStoppedError, after writing a checkpoint, when the context asks for a stop."""
        self.done += 1
        self._context.progress(self.done, self._total, **metrics)
        stop = self._context.should_stop()
        if stop or time.monotonic() - self._saved_at >= self._context.checkpoint_interval_s:
            arrays = {"done": np.array(self.done), "errors": self._errors}
            arrays |= nested("model", self._model.arrays()) | nested("moments", self._model.moments())
            self._checkpoints.save(self.done, arrays)
            self._saved_at = time.monotonic()
        if stop and self.done < self._total:
            raise JobStoppedError(f"stopped after {self.done} of {self._total} parts")


class ExactInverseDynamics(Weighting):
    """ID without a model to learn: the residuals of the physical check in place of its errors.

    The error of a demonstration is the distance, after one step, that `Reproducibility.SHARE` of its trials keep.
    """

    name = "exact_inverse_dynamics"
    title = "exact ID"
    version = 2
    inputs = ("demonstrations", "reproducibility")

    def settings(self, config: RunConfig) -> dict[str, Any]:
        """Return nothing: what the residuals depend on is part of its input."""
        return {}

    def run_job(self, run: Run, job: str, context: JobContext) -> Files:
        """Turn residuals into scores, by the linear rule of ID.

        What can be followed leaves up to `Reproducibility.LIMIT`, so that much costs nothing. Nothing is held out that
        could say what costs everything, so the largest residual does, as in ID where no demonstration is as near as
        what is held out.
        """
        errors = _errors(Reproducibility.load(run.artifact(ReproducibilityStage.name)))
        known = errors[np.isfinite(errors)]
        found = Following(errors, Reproducibility.LIMIT, float(known.max(initial=Reproducibility.LIMIT)))
        return judged(found, errors).files() | found.files()

    def score(self, run: Run, demonstrations: Demonstrations) -> Transferability:
        """Follow other demonstrations, in the units of the run's own, and judge them by the run's bounds."""
        config, known = run.config, load_demonstrations(run)
        chosen, section = range(len(demonstrations)), section_of(config)
        seen = follow(demonstrations, chosen, config.environment, section, config.seed, measure=known)
        return judged(Following.load(run.artifact(self.name)), _errors(seen), seen.env_steps)


def judged(found: Following, errors: NDArray[np.float64], env_steps: int = 0) -> Transferability:
    """Return scores of (N,) errors by known bounds, and weights in proportion to them.

    A score is exact as far as the method knows. What is followed more closely than the upper bound is kept.
    """
    scores = found.scores(errors)
    exact = np.stack((scores, scores), axis=1)
    weights, clusters = kept_weights(scores, exact, ABOVE_NOTHING), np.full(len(scores), -1, np.int32)
    return Transferability(scores, weights, clusters, exact, ABOVE_NOTHING, env_steps=env_steps)


def _errors(found: Reproducibility) -> NDArray[np.float64]:
    """Return (N,) errors; infinite where no state tells where the simulator is: what is not known does not count."""
    errors = np.quantile(found.one_step, Reproducibility.SHARE, axis=1)
    return np.where(np.isnan(errors), np.inf, errors)


def _exploration(config: RunConfig) -> TrainingConfig:
    """Return how experience is collected."""
    return TrainingConfig(total_steps=config.inverse_dynamics.transitions)


def _untrained(config: RunConfig, spec: EnvironmentSpec) -> GaussianPolicy:
    """Return a policy as it is before any training, with a standard deviation of 1."""
    import torch

    from oodil.pipeline.algorithms.networks import PolicyNetwork

    rng = torch.Generator().manual_seed(torch_seed(derive_key(config.seed, "inverse_dynamics", "explorer")))
    return PolicyNetwork(spec.observation_dim, spec.action_dim, _exploration(config).policy_hidden, rng).export()


def _follower(config: RunConfig, model: "InverseModel") -> ModelFollower:
    """Return simulators of the imitator's environment, whose actions a model chooses."""
    environment = config.environment
    bounds = environment_spec(environment.id, environment.dynamics).bounds()
    return ModelFollower(make_batch(environment.id, environment.dynamics, SIMULATORS), bounds, model)


register(InverseDynamics("inverse_dynamics_random", title="ID without GAIL", explorer=None))
register(InverseDynamics("inverse_dynamics_gail", title="ID with GAIL", explorer="naive_gail"))
register(ExactInverseDynamics())
