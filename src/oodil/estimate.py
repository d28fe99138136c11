"""What an experiment will take: environment steps by run, what runs share, and hours on this machine."""

from dataclasses import dataclass

from oodil.bench import side_by_side_rate
from oodil.experiments import Table
from oodil.pipeline.artifacts import fingerprint
from oodil.pipeline.config import RunConfig
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import Stage

OVERHEAD = 1.4
"""Time by what the steps of trainings alone would take: collecting, clustering, reading, evaluation come on top.
Measured on the configuration `quickstart`."""


@dataclass(frozen=True)
class Outlook:
    """What is left to do for a run."""

    name: str
    config: RunConfig
    env_steps: int
    """Of its trainings, without what it takes over."""
    finished: list[str]
    """Stages that some run of the table has finished."""
    shared: list[str]
    """Stages that a run before it in the list computes."""
    own: list[str]
    """Stages that it computes itself."""


def outlook(table: Table, selected: dict[str, list[Stage]]) -> list[Outlook]:
    """Return what is left to do for the selected runs, in their order."""
    runs = {run.name: run for run in table.runs}
    results = {run.name: RunResults(table.opened(run)) for run in table.runs}
    done = {part for run in table.runs for stage, part in run.parts.items() if results[run.name].is_done(stage)}
    taken: set[str] = set()
    found = []
    for name, stages in selected.items():
        parts, config = runs[name].parts, runs[name].config
        kinds: dict[str, list[Stage]] = {"finished": [], "shared": [], "own": []}
        for stage in stages:
            part = parts[stage.name]
            kinds["finished" if part in done else "shared" if part in taken else "own"].append(stage)
            taken.add(part)
        steps = sum(stage.planned_steps(config) for stage in kinds["own"])
        names = {kind: [stage.name for stage in those] for kind, those in kinds.items()}
        found.append(Outlook(name, config, steps, **names))
    return found


def hours(found: list[Outlook], workers: int) -> float:
    """Return about how many hours the rest takes with this many runs at once, from a measurement of some seconds.

    The learner loop is measured for each environment and each way to learn, in as many processes at once.
    """
    at_once = max(1, min(workers, sum(each.env_steps > 0 for each in found)))
    rates: dict[str, float] = {}
    seconds = []
    for each in found:
        if not each.env_steps:
            continue
        learning = each.config.imitation.gail.model_dump(mode="json", exclude={"total_steps"})
        kind = fingerprint([each.config.environment.id, learning])
        if kind not in rates:
            rates[kind] = side_by_side_rate(each.config, at_once)
        seconds.append(OVERHEAD * each.env_steps / rates[kind])
    return max(sum(seconds) / at_once, max(seconds, default=0.0)) / 3600
