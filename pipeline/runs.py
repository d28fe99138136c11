"""A run's folder as its user sees it: where every stage stands, and what the finished ones left behind, typed.

A stage whose artifact is stale or damaged counts as missing here, so that figures of two different sets of
demonstrations never meet, on a page or in a script.
"""

import json
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.algorithms.weights import effective_number, sampling_mass
from oodil.pipeline.artifacts import Artifact
from oodil.pipeline.config import RunConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.errors import ConfigError, DataError, NotFinishedError
from oodil.pipeline.results import (
    Assignment,
    ClusterDiagnostics,
    Evaluation,
    LearningCurve,
    Policy,
    Reproducibility,
    Trainings,
    Transferability,
)
from oodil.pipeline.stage import Run, StageState, state_of
from oodil.pipeline.stages import PolicyStage, Weighting, needed_for, policies_of, stages, weightings_of
from oodil.pipeline.stages.demonstrations import load_demonstrations, transferable_marks
from oodil.pipeline.suggestion import Suggestion, suggest
from oodil.pipeline.verdicts import VerdictTable

POWERS = 1, 2, 4, 8
"""Of the scores, for comparison: what weights would have been without a rule of what is kept."""


class RunResults:
    """What a run has produced. Every getter raises NotFinishedError, with the reason, for what cannot be used."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.states: dict[str, StageState] = {}
        """Where each stage stands, in the order of the stages. A stage whose input is stale is stale, too."""
        for stage in stages(run.config):
            state = state_of(stage, run)
            unusable = [name for name in stage.inputs if self.states[name].state in ("stale", "damaged")]
            if state.state == "done" and unusable:
                reason = f"its input {unusable[0]} is {self.states[unusable[0]].state}"
                state = StageState("stale", reason, follows_input=True)
            self.states[stage.name] = state

    @property
    def config(self) -> RunConfig:
        """The run's configuration."""
        return self.run.config

    @property
    def path(self) -> Path:
        """The run's folder."""
        return self.run.directory.path

    @property
    def policies(self) -> list[PolicyStage]:
        """The policies that this run is meant to have, ours first."""
        return policies_of(self.config)

    @property
    def weightings(self) -> list[Weighting]:
        """The weightings that this run is meant to have, ours first."""
        return weightings_of(self.config)

    def is_done(self, stage: str) -> bool:
        """Return whether a stage's artifact can be used."""
        return stage in self.states and self.states[stage].state == "done"

    def artifact(self, stage: str) -> Artifact:
        """Return the artifact of a stage. Raises NotFinishedError unless it can be used."""
        if stage not in self.states:
            raise ConfigError(f"no stage {stage!r}; this run has {', '.join(self.states)}")
        state = self.states[stage]
        if state.artifact is None:
            reason = f" ({state.reason})" if state.reason else ""
            raise NotFinishedError(
                f"{self.path}: {stage} is {state.state}{reason}; `oodil run` or `resume` computes it"
            )
        return state.artifact

    @cached_property
    def demonstrations(self) -> Demonstrations:
        """What is imitated, under the labels of the configuration; read once, since all figures ask for it."""
        self.artifact("demonstrations")
        return load_demonstrations(self.run)

    @property
    def assignment(self) -> Assignment:
        """Which cluster each demonstration belongs to."""
        return Assignment.load(self.artifact("clustering"))

    @property
    def cluster_diagnostics(self) -> ClusterDiagnostics:
        """How good the clusters are."""
        return ClusterDiagnostics.load(self.artifact("clustering"))

    @property
    def reproducibility(self) -> Reproducibility:
        """How closely the imitator's simulator can follow every demonstration."""
        return Reproducibility.load(self.artifact("reproducibility"))

    @property
    def transferability(self) -> Transferability:
        """What our weighting says of every demonstration."""
        return self.weighting("transferability")

    def weighting(self, name: str) -> Transferability:
        """Return what a weighting says of every demonstration."""
        return Transferability.load(self.artifact(name))

    def policy(self, name: str = "imitation") -> Policy:
        """Return a trained policy. Raises ConfigError for one that the run does not have."""
        known = [each.name for each in self.policies]
        if name not in known:
            raise ConfigError(f"{self.path}: no policy {name!r}; this run has {', '.join(known)}")
        return Policy.load(self.artifact(name))

    def evaluation(self, name: str = "imitation") -> Evaluation:
        """Return the final evaluation of a policy."""
        return Evaluation.load(self.artifact(name))

    def curve(self, name: str = "imitation") -> LearningCurve:
        """Return a policy's learning curve."""
        return LearningCurve.load(self.artifact(name))

    def trainings(self, name: str = "imitation") -> Trainings:
        """Return all trainings of a policy; the one that was kept is the first."""
        return Trainings.load(self.artifact(name))

    def verdicts(self, weighting: str = "transferability") -> VerdictTable:
        """Return what a weighting says of each source, of each cluster and of all demonstrations."""
        return VerdictTable.of(self.weighting(weighting), self.demonstrations)

    @cached_property
    def suggestion(self) -> Suggestion | None:
        """How many clusters the embedding suggests; None where it tells too little apart."""
        return suggest(self.assignment)

    def score(self, demonstrations: Demonstrations, weighting: str = "transferability") -> Transferability:
        """Return what a finished weighting says of other demonstrations; nothing is trained.

        Raises CannotScoreError for a weighting that cannot, ConfigError for one that the run does not have, and
        DataError when the states have another dimension.
        """
        known = [each.name for each in self.weightings]
        if weighting not in known:
            raise ConfigError(f"{self.path}: no weighting {weighting!r}; this run has {', '.join(known)}")
        self.artifact(weighting)
        self.refuse_other_states(demonstrations, "demonstrations")
        stage = next(each for each in self.weightings if each.name == weighting)
        return stage.score(self.run, demonstrations)

    def refuse_other_states(self, demonstrations: Demonstrations, origin: str) -> None:
        """Raise DataError, naming where they are from, for states of another dimension than those of the run."""
        dim, expected = demonstrations.observation_dim, self.demonstrations.observation_dim
        if dim != expected:
            raise DataError(f"{origin}: states have {dim} dimensions; those of {self.path} have {expected}")

    def table(self, weighting: str = "transferability") -> list[dict[str, Any]]:
        """Return one row a demonstration: number, source, states, cluster, transferability and weight."""
        demonstrations = self.demonstrations
        return [
            {
                "demonstration": row["demonstration"],
                "source": demonstrations.source_labels[demonstrations.sources[n]],
                "states": int(demonstrations.lengths[n]),
                **row,
            }
            for n, row in enumerate(self.weighting(weighting).table())
        ]

    def marks(self) -> NDArray[np.bool_] | None:
        """Return (N,) whether each demonstration's source is marked transferable; None unless all are marked."""
        marks = transferable_marks(self.config, self.demonstrations.source_labels)
        if None in marks:
            return None
        return np.array(marks, np.bool_)[self.demonstrations.sources]

    def separation(self, weighting: str = "transferability") -> dict[str, float]:
        """Return how well a weighting tells what is marked transferable from what is marked not to be.

        ``auroc`` of the scores, and the former's share of the sampling mass: ``share_before`` weighting, ``share`` with
        the weights, and ``share_power_1``, 2, 4 and 8 with that power of the scores instead; ``effective_number`` of
        those that are marked transferable. Empty without marks of both kinds. Sources without a mark are left out, as
        if they were not there.
        """
        found, demonstrations = self.weighting(weighting), self.demonstrations
        by_source = transferable_marks(self.config, demonstrations.source_labels)
        known = np.flatnonzero(np.array([mark is not None for mark in by_source])[demonstrations.sources])
        marks = np.array([mark is True for mark in by_source])[demonstrations.sources[known]]
        if not 0 < marks.sum() < len(marks) or not found.weights[known].any():
            return {}
        return separation_metrics(marks, found.scores[known], found.weights[known], demonstrations.select(known))

    def env_steps(self) -> dict[str, int]:
        """Return the environment steps that each finished stage took; stages that take none are left out."""
        finished = [stage for stage in stages(self.config) if self.is_done(stage.name)]
        steps = {stage.name: stage.env_steps(self.run) for stage in finished}
        return {name: count for name, count in steps.items() if count}

    def env_steps_of(self, policy: PolicyStage) -> int:
        """Return the environment steps of a finished policy and of all that it follows from."""
        return sum(stage.env_steps(self.run) for stage in needed_for(self.config, [policy.name]))

    def seconds(self) -> dict[str, float]:
        """Return how long each finished stage took, with what was spent on it before an interruption.

        A stage that is computed again counts anew, unless its jobs were reused: reading their scores in another way
        takes no time, and says nothing of the time that they took.
        """
        spent: dict[str, float] = {}
        finished: set[str] = set()
        for event in _events(self.run):
            stage = event.get("stage")
            if not isinstance(stage, str):
                continue
            if event.get("event") == "stage_started" and stage in finished and event.get("jobs") != 0:
                spent[stage] = 0.0
            spent[stage] = spent.get(stage, 0.0) + _spent(event)
            if event.get("event") == "stage_finished":
                finished.add(stage)
        return {stage: seconds for stage, seconds in spent.items() if stage in finished}

    def began_at(self) -> float:
        """Return when its first command began, in seconds since 1970; infinity if there was none."""
        return next((float(event["time"]) for event in _events(self.run) if "time" in event), inf)

    def seconds_ever(self) -> float:
        """Return how long all stages took, with what was interrupted and what was computed again since."""
        return sum(map(_spent, _events(self.run)))

    def summary(self) -> dict[str, Any]:
        """Return the results known so far, as JSON values.

        ``policies`` by name: mean and std of the return, episodes, env_steps; ``weightings`` by name: see `separation`;
        ``verdicts`` by name, of weightings that train imitators: see `VerdictTable`; ``purity``; ``reproducibility``
        with the name and the distance of each of ``sources``, whether it is ``reproducible``, and whether that is
        ``everything``; ``env_steps`` and ``seconds`` of all that was run. What is not known is left out.
        """
        policies, weightings, verdicts = {}, {}, {}
        for policy in self.policies:
            if self.is_done(policy.name):
                final = self.evaluation(policy.name)
                policies[policy.name] = {
                    "mean_return": final.mean_return if np.isfinite(final.mean_return) else None,
                    "std_return": final.std_return if np.isfinite(final.std_return) else None,
                    "episodes": len(final),
                    "env_steps": self.policy(policy.name).env_steps,
                }
        for weighting in self.weightings:
            if self.is_done(weighting.name) and self.is_done("demonstrations"):
                weightings[weighting.name] = self.separation(weighting.name)
                if self.weighting(weighting.name).history:
                    verdicts[weighting.name] = self.verdicts(weighting.name).describe()
        reproducibility: dict[str, Any] = {}
        if self.is_done("reproducibility") and self.is_done("demonstrations"):
            known, labels = self.reproducibility, self.demonstrations.source_labels
            distances, chosen = known.by_source(self.demonstrations), known.reproducible_sources(self.demonstrations)
            reproducibility = {
                "sources": [
                    {"name": label, "distance": distance, "reproducible": is_reproducible}
                    for label, distance, is_reproducible in zip(labels, distances, chosen, strict=True)
                ],
                "everything": all(chosen),
            }
        found: dict[str, Any] = {
            "policies": policies,
            "weightings": {name: figures for name, figures in weightings.items() if figures},
            "verdicts": verdicts,
            "reproducibility": reproducibility,
            "purity": self.cluster_diagnostics.purity if self.is_done("clustering") else None,
            "env_steps": sum(self.env_steps().values()),
            "seconds": sum(self.seconds().values()),
        }
        return {name: value for name, value in found.items() if value}

    def describe(self) -> dict[str, Any]:
        """Return the state of every stage and the results known so far, as JSON values."""
        seconds = self.seconds()
        described = {}
        for name, state in self.states.items():
            entry: dict[str, Any] = {
                "state": state.state,
                "sha256": state.artifact.sha256 if state.artifact else None,
            }
            if state.reason:
                entry["reason"] = state.reason
            if name in seconds:
                entry["seconds"] = round(seconds[name], 1)
            described[name] = entry
        return {
            "run": str(self.path),
            "name": self.config.name,
            "seed": self.config.seed,
            "stages": described,
            "results": self.summary(),
        }


def separation_metrics(
    marks: NDArray[np.bool_], scores: NDArray[np.float64], weights: NDArray[np.float64], demonstrations: Demonstrations
) -> dict[str, float]:
    """Return what `RunResults.separation` does for (N,) marks of both kinds, scores and weights.

    What is unlike all that is known has no score, and counts as 0.
    """
    from sklearn.metrics import roc_auc_score

    scores = np.nan_to_num(scores)
    by_share = {"share_before": np.ones(len(demonstrations)), "share": weights}
    by_share |= {f"share_power_{power}": scores**power + 1e-300 for power in POWERS}
    shares = {name: float(sampling_mass(w, demonstrations)[marks].sum()) for name, w in by_share.items()}
    auroc = float(roc_auc_score(marks, scores))
    kept = weights[marks]
    return {"auroc": auroc, **shares, "effective_number": effective_number(kept)}


def shown_return(value: float) -> str:
    """Return an episode return in the digits that it deserves."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _spent(event: dict[str, Any]) -> float:
    """Return the seconds that a stage took up to its end or to a stop, if that is what an event tells."""
    seconds = event.get("seconds") if event.get("event") in ("stage_finished", "stage_interrupted") else None
    return float(seconds) if isinstance(seconds, int | float) else 0.0


def _events(run: Run) -> list[dict[str, Any]]:
    try:
        lines = run.directory.events.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return []
    events = []
    for line in lines:
        try:
            event = json.loads(line)
        except ValueError:  # a line cut short by a kill
            continue
        if isinstance(event, dict):
            events.append(event)
    return events
