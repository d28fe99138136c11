"""What is computed again, and what is not: each field of the configuration that changes a result, and no other."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import oodil
from oodil.pipeline.config import RunConfig
from oodil.pipeline.stage import Run, stage_named
from oodil.pipeline.stages import stages
from oodil.pipeline.stages.experts import ExpertsStage
from tests.runs import MICRO

pytestmark = pytest.mark.timeout(300)
BASELINES = "baselines=[naive_gail, oracle]"

IRRELEVANT = [
    "demonstrations.sources.0.label=renamed",
    "demonstrations.sources.1.label='12'",
    "demonstrations.sources.0.expert_discount=0.9",
    "evaluation.num_points=7",
    "evaluation.episodes=9",
    "evaluation.final_episodes=99",
    "evaluation.num_scores=3",
    "runtime.workers=7",
    "runtime.checkpoint_interval_s=99",
    "runtime.unit_timeout_s=9",
    "runtime.job_timeout_s=99",
    "runtime.max_attempts=9",
    "runtime.max_worker_restarts=9",
    "runtime.restart_delay_s=9",
    "runtime.modules=elsewhere",
    "runtime.logger=wandb",
]
MARKS = "demonstrations.sources.1.transferable=true"
RELEVANT = {
    "demonstrations.sources.0.count=4": ("demonstrations", "sources[0].count 3 -> 4"),
    "demonstrations.sources.0.dynamics.gravity=9.9": ("demonstrations", "sources[0].dynamics.gravity 9.8 -> 9.9"),
    "demonstrations.deterministic=true": ("demonstrations", "deterministic False -> True"),
    "clustering.temperature=0.5": ("clustering", "temperature 1.0 -> 0.5"),
    "transferability.num_trainings=2": ("imitators", "num_trainings 1 -> 2"),
    "transferability.gail.lag=0": ("imitators", "gail.lag 1 -> 0"),
    "transferability.reading.steps=11": ("transferability", "reading.steps 10 -> 11"),
    "transferability.kept_from=0.25": ("transferability", "kept_from 0.5 -> 0.25"),
    "imitation.gail.discount=0.9": ("imitation", "gail.discount 0.995 -> 0.9"),
    "imitation.num_candidates=1": ("imitation", "num_candidates 2 -> 1"),
    MARKS: ("marks", "transferable[1] False -> True"),
}


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    path = tmp_path_factory.mktemp("fingerprints") / "run"
    oodil.run(MICRO, [BASELINES], workers=0, run_dir=path)
    return path


def states(run_dir: Path, override: str) -> dict[str, tuple[str, str]]:
    """Return where each stage of a finished run would stand under a changed configuration."""
    config = oodil.load_config(MICRO, [BASELINES, override])
    opened = oodil.open_run(run_dir)
    changed = oodil.RunResults(Run(config, opened.run.directory))
    return {name: (state.state, state.reason) for name, state in changed.states.items()}


@pytest.mark.parametrize("override", IRRELEVANT)
def test_what_is_only_reported_or_only_speed_computes_nothing_again(run_dir: Path, override: str) -> None:
    assert {state for state, _ in states(run_dir, override).values()} == {"done"}, override


@pytest.mark.parametrize("override", RELEVANT)
def test_what_changes_a_result_makes_its_stage_stale_and_names_the_field(run_dir: Path, override: str) -> None:
    stage, reason = RELEVANT[override]
    found = states(run_dir, override)
    assert found[stage] == ("stale", reason)
    order = list(found)
    assert all(found[name][0] == "done" for name in order[: order.index(stage)])


def test_a_mark_touches_the_oracle_alone(run_dir: Path) -> None:
    stale = {name for name, (state, _) in states(run_dir, MARKS).items() if state == "stale"}
    assert stale == {"marks", "oracle"}


def test_a_mark_that_nothing_uses_touches_nothing(run_dir: Path) -> None:
    opened = oodil.open_run(run_dir).run.directory
    for mark in (MARKS, "demonstrations.sources.1.transferable=null"):
        found = oodil.RunResults(Run(oodil.load_config(MICRO, ["baselines=[naive_gail]", mark]), opened)).states
        assert set(found) >= {"demonstrations", "clustering", "imitators", "transferability", "imitation", "naive_gail"}
        assert {state.state for state in found.values()} == {"done"}, mark


def test_experts_alone_depend_on_how_they_are_trained() -> None:
    """`expert_discount` is theirs; marks, labels and counts are not."""

    def settings(*overrides: str) -> dict[str, object]:
        return ExpertsStage().settings(oodil.load_config(MICRO, [BASELINES, *overrides]))

    assert settings("demonstrations.sources.0.expert_discount=0.9") != settings()
    assert settings("demonstrations.sources.0.dynamics.gravity=9.9") != settings()
    for override in (MARKS, "demonstrations.sources.0.label=renamed", "demonstrations.sources.0.count=9"):
        assert settings(override) == settings(), override


def test_the_dynamics_of_the_imitator_collect_nothing_again(run_dir: Path) -> None:
    """What experts return in it is measured anew; the demonstrations of each source are kept."""
    override = "environment.dynamics.gravity=13"
    assert states(run_dir, override)["demonstrations"] == ("stale", "imitator.gravity 12.0 -> 13.0")
    kept, changed = (
        Run(oodil.load_config(MICRO, [BASELINES, *more]), oodil.open_run(run_dir).run.directory)
        for more in ((), (override,))
    )
    stage = stage_named("demonstrations")
    for job in stage.jobs(kept):
        assert stage.job_origin(changed, job) == stage.job_origin(kept, job)


def fields(section: type, prefix: str = "") -> Iterator[str]:
    """Yield the path of every field below a section that is not a section itself."""
    for name, field in section.model_fields.items():
        if isinstance(field.annotation, type) and hasattr(field.annotation, "model_fields"):
            yield from fields(field.annotation, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def test_no_field_of_evaluation_or_runtime_is_forgotten() -> None:
    listed = {override.partition("=")[0] for override in IRRELEVANT}
    found = {field for field in fields(RunConfig) if field.split(".")[0] in ("evaluation", "runtime")}
    assert found == {field for field in listed if field.split(".")[0] in ("evaluation", "runtime")}


def test_a_stale_stage_is_shown_and_not_used(run_dir: Path) -> None:
    config = oodil.load_config(MICRO, [BASELINES, "transferability.kept_from=0.25"])
    results = oodil.RunResults(Run(config, oodil.open_run(run_dir).run.directory))
    described = results.describe()["stages"]
    assert described["transferability"] == described["transferability"] | {
        "state": "stale",
        "reason": "kept_from 0.5 -> 0.25",
        "sha256": None,
    }
    assert described["imitation"]["state"] == "stale"
    assert described["imitation"]["reason"] == "its input transferability is stale"
    for use in (lambda: results.transferability, results.policy, results.evaluation):
        with pytest.raises(oodil.OodilError, match="is stale"):
            use()
    assert results.policy("naive_gail")
    assert "imitation" not in results.summary()["policies"]


ALL = "baselines=[naive_gail, naive_gail_all_steps, f_mdp, f_mdp_per_source, id_random, id_gail, exact_id, oracle]"
WORDS = {
    "contrastive": "states",
    "fixed_length": "fixed_stride",
    "sum": "mean",
    "silhouette": "kmeans",
    "step_first": "centers_first",
    "fresh": "last",
    "trpo": "ppo",
    "change": "raw",
}
WIDTHS = ("imitation.gail.policy_hidden", "imitation.gail.value.hidden")
NOT_ALONE = {
    *WIDTHS,  # The imitators' change with them.
    *(width.replace("imitation", "transferability") for width in WIDTHS),
    "environment.id",
    "demonstrations.file",  # There are sources.
    "demonstrations.labels",
    "demonstrations.transferable",
    "demonstrations.unmarked",
    "demonstrations.sources.0.expert",
    "demonstrations.sources.1.expert",
    "demonstrations.sources.0.label",  # Reported, as is tested above.
    "demonstrations.sources.1.label",
    "demonstrations.sources.0.transferable",  # The oracle needs one.
    "oracle_target",
    "preset",  # The fields that it sets are flipped themselves.
}
"""Fields that cannot be changed alone, or need more than another number or word."""


def leaves(values: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value of nested mappings and lists of mappings with its path."""
    if isinstance(values, list) and values and isinstance(values[0], dict):
        values = dict(enumerate(values))
    if isinstance(values, dict):
        for name, value in values.items():
            yield from leaves(value, f"{path}.{name}" if path else name)
    else:
        yield path, values


def others(value: Any) -> list[Any]:
    """Return values that a field might have instead."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value - 1, 2 * value]
    if isinstance(value, float):
        return [0.5 * value, 0.9 * value, value + 0.1]
    if isinstance(value, list):
        return [[2 * each for each in value if isinstance(each, int)]]
    return [0.5, 1] if value is None else [WORDS[value]] if value in WORDS else []


def test_every_field_that_changes_a_result_is_seen_by_a_stage() -> None:
    """One that is forgotten would change a result under an old fingerprint; name and seed are in every origin."""

    def settings(*overrides: str) -> tuple[Any, list[Any]]:
        config = oodil.load_config(MICRO, [ALL, "reproducibility={}", *overrides])
        return config, [stage.settings(config) for stage in (*stages(config), ExpertsStage())]

    config, before = settings()
    unseen, not_alone = set(), set()
    of_no_result = {"name", "seed", "baselines", "evaluation", "runtime", "finetuning"}
    for path, value in leaves(config.model_dump(mode="json", exclude=of_no_result)):
        for other in others(value):
            try:
                changed, after = settings(f"{path}={json.dumps(other)}")
            except oodil.OodilError:
                continue
            if changed != config:
                if after == before:
                    unseen.add(path)
                break
        else:
            not_alone.add(path)
    assert not unseen
    assert not_alone == NOT_ALONE
