"""What a run has produced so far, read from its artifacts; figures are taken as they were written, never recomputed."""

import json
from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from oodil.pipeline.artifacts import Artifact
from oodil.pipeline.errors import DamagedArtifactError, NotFinishedError
from oodil.pipeline.stage import Run

STAGES = ("demonstrations", "clustering", "transferability", "imitation", "naive_gail", "oracle")
"""In the order in which they depend on each other."""


class Results:
    """The artifacts of a run that can be used now, and why the others cannot.

    An artifact counts only while its inputs are the ones that stand in the run directory, so figures of two different
    sets of demonstrations never meet on one page.
    """

    def __init__(self, run: Run) -> None:
        self.run = run
        self.artifacts: dict[str, Artifact] = {}
        self.problems: dict[str, str] = {}
        """What is wrong with a stage; only of stages that this run is meant to have."""
        expected = {*STAGES[:4], *run.config.baselines}
        for stage in STAGES:
            try:
                artifact = run.artifact(stage)
            except NotFinishedError:
                if stage in expected:
                    self.problems[stage] = "not finished"
                continue
            except DamagedArtifactError as error:
                self.problems[stage] = f"damaged ({error})"
                continue
            changed = [name for name, sha256 in artifact.origin.get("inputs", {}).items() if self._hash(name) != sha256]
            if changed:
                self.problems[stage] = f"out of date, because {' and '.join(changed)} changed or went missing since"
            else:
                self.artifacts[stage] = artifact

    def _hash(self, stage: str) -> str | None:
        return self.artifacts[stage].sha256 if stage in self.artifacts else None

    def json(self, stage: str, name: str) -> dict[str, Any]:
        """Return the object in a JSON file of a stage; empty when it cannot be had."""
        return self._read(stage, name, Artifact.json)

    def arrays(self, stage: str, name: str) -> dict[str, NDArray[Any]]:
        """Return the arrays in a file of a stage; empty when they cannot be had."""
        return self._read(stage, name, Artifact.arrays)

    def _read(self, stage: str, name: str, read: Callable[[Artifact, str], Any]) -> dict[str, Any]:
        artifact = self.artifacts.get(stage)
        if artifact is None or name not in artifact.hashes:
            return {}
        try:
            return dict(read(artifact, name))
        except DamagedArtifactError as error:
            self.problems[stage] = f"damaged ({error})"
            return {}

    def env_steps(self) -> dict[str, int]:
        """Return the environment steps that each finished training took."""
        steps: dict[str, Any] = {stage: self.json(stage, "evaluation.json").get("env_steps") for stage in STAGES[3:]}
        steps["transferability"] = self.json("transferability", "summary.json").get("env_steps")
        return {stage: steps[stage] for stage in STAGES if steps.get(stage) is not None}

    def seconds(self) -> dict[str, float]:
        """Return how long each finished stage took, with what was spent on it before an interruption.

        A stage that is computed again counts anew, unless its jobs were reused: reading their scores in another way
        takes no time, and says nothing of the time that they took.
        """
        spent: dict[str, float] = {}
        finished: set[str] = set()
        for event in _events(self.run):
            stage, seconds = event.get("stage"), event.get("seconds")
            if not isinstance(stage, str):
                continue
            if event.get("event") == "stage_started" and stage in finished and event.get("jobs") != 0:
                spent[stage] = 0.0
            if event.get("event") in ("stage_finished", "stage_interrupted") and isinstance(seconds, int | float):
                spent[stage] = spent.get(stage, 0.0) + float(seconds)
            if event.get("event") == "stage_finished":
                finished.add(stage)
        return {stage: seconds for stage, seconds in spent.items() if stage in finished}


def summary(run: Run) -> dict[str, float]:
    """Return the results known so far; a key is there only when its value is.

    ``env_steps`` and ``seconds`` cover everything that was run: the jobs, the final policy and the baselines.
    """
    results = Results(run)
    scores = results.json("transferability", "summary.json")
    found = {
        "final_return": results.json("imitation", "evaluation.json").get("final_return"),
        "naive_return": results.json("naive_gail", "evaluation.json").get("final_return"),
        "oracle_return": results.json("oracle", "evaluation.json").get("final_return"),
        "purity": results.json("clustering", "diagnostics.json").get("purity"),
        "auroc": scores.get("auroc"),
        "transferable_share": scores.get("transferable_share"),
        "env_steps": sum(results.env_steps().values()) or None,
        "seconds": sum(results.seconds().values()) or None,
    }
    return {name: value for name, value in found.items() if value is not None}


def shown_return(value: float) -> str:
    """Return an episode return in the digits that it deserves."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


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
