"""What an experiment's file says: the runs that follow from it, what they have in common, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from oodil.estimate import outlook
from oodil.experiments import Table
from oodil.pipeline.environments.goals import reached_goal
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.experiment import ExperimentConfig, labels, load_experiment, plan
from oodil.pipeline.loading import shipped_configs, shipped_experiments
from oodil.whole_runs import _without_what_follows
from tests.runs import MICRO

VALUES: dict[str, Any] = {
    "name": "micro",
    "run": str(MICRO),
    "rows": {"1:2": [], "2:1": {"demonstrations.sources.0.count": 4}},
    "methods": [
        "imitation",
        "naive_gail",
        {"name": "kept", "policy": "imitation", "overrides": ["transferability.kept_from=0"]},
        {"name": "plain", "label": "k-means", "policy": "imitation", "overrides": {"clustering.features": "states"}},
    ],
    "seeds": "3-4",
    "measure": "mean_return",
}


@pytest.fixture
def experiment(tmp_path: Path):
    """Return a function that loads an experiment of some values."""

    def load(**changes: Any) -> ExperimentConfig:
        path = tmp_path / "experiment.yaml"
        path.write_text(yaml.safe_dump(VALUES | changes, sort_keys=False))
        return load_experiment(path)

    return load


@pytest.mark.parametrize("name", shipped_experiments())
def test_every_experiment_that_comes_along_can_be_planned(name):
    assert plan(load_experiment(name))
    assert not any(known.startswith("experiments") for known in shipped_configs())


def test_methods_without_overrides_are_one_run_and_each_other_one_is_its_own(experiment):
    loaded = experiment()
    runs = {run.name: run for run in plan(loaded)}
    variants = [f"{row}{variant}-seed{seed}" for row in ("1-2", "2-1") for seed in (3, 4) for variant in _VARIANTS]
    assert list(runs) == variants
    together, kept = runs["2-1-seed4"], runs["2-1-kept-seed4"]
    assert (together.row, together.seed, together.config.seed) == ("2:1", 4, 4)
    assert together.methods == {"imitation": "imitation", "naive_gail": "naive_gail"}
    assert together.config.baselines == ("naive_gail",)
    assert together.config.demonstrations.sources[0].count == 4
    assert (kept.methods, kept.config.baselines) == ({"kept": "imitation"}, ())
    assert kept.config.transferability.kept_from == 0 and kept.config.demonstrations.sources[0].count == 4
    assert labels(loaded, list(runs.values())) == {
        "imitation": "ours",
        "naive_gail": "naive GAIL",
        "kept": "kept",
        "plain": "k-means",
    }


_VARIANTS = ("", "-kept", "-plain")


def test_parts_are_equal_where_the_artifacts_will_be(experiment):
    runs = {run.name: run for run in plan(experiment())}
    ours, kept, plain = (runs[f"1-2{variant}-seed3"].parts for variant in _VARIANTS)
    # The rule of what is kept changes no reading, which the jobs of transferability are, but the policy.
    same = {name for name in kept if kept[name] == ours[name]}
    assert same == {"demonstrations", "clustering", "imitators", "transferability"}
    assert {name for name in plain if plain[name] == ours[name]} == {"demonstrations"}
    assert not set(ours.values()) & set(runs["1-2-seed4"].parts.values())
    assert not set(ours.values()) & set(runs["2-1-seed3"].parts.values())
    measured = plan(experiment(overrides=["evaluation.episodes=3"]))[0].parts
    assert not set(ours.values()) & set(measured.values())


def test_only_what_the_methods_need_is_computed(experiment, tmp_path):
    table = Table.of(experiment(), tmp_path / "micro")
    chosen = table.select(["1:2"], ["naive_gail"])
    found = {run: [stage.name for stage in stages] for run, stages in chosen.items()}
    assert found == {f"1-2-seed{seed}": ["demonstrations", "naive_gail"] for seed in (3, 4)}
    # 4,800 steps in iterations of 4 groups x 2 simulators x 20 steps, and 2 x 8 + 16 episodes that measure.
    assert [each.cost.env_steps for each in outlook(table, chosen)] == [36_800, 36_800]
    everything = {each.name: each for each in outlook(table, table.select(None, None))}
    # The longest first: 2 clusters x 2,400 steps, of which 16 episodes measure and 32 are read, and two policies.
    assert next(iter(everything)) == "1-2-seed3"
    # Ours looks at 16 episodes before it goes on from an imitator.
    assert everything["1-2-seed3"].cost.env_steps == 2 * (2_400 + 48_000) + 2 * 36_800 + 16_000
    assert everything["1-2-kept-seed3"].cost.env_steps == 36_800 + 16_000
    assert everything["1-2-kept-seed3"].own == ["imitation"]
    assert everything["1-2-plain-seed3"].shared == ["demonstrations"]
    assert not list(tmp_path.glob("micro*"))


def test_more_trainings_of_the_same_are_not_taken_for_what_is_there(experiment, tmp_path):
    rows = {str(count): {"transferability.num_trainings": count} for count in (1, 2)}
    table = Table.of(experiment(rows=rows, methods=["imitation"], seeds=3), tmp_path / "micro")
    chosen = table.select(None, None)
    assert list(chosen) == ["2-seed3", "1-seed3"]
    two, one = outlook(table, chosen)
    assert "imitators" in two.own and "imitators" in one.shared
    one, two = outlook(table, dict(reversed(chosen.items())))
    assert "imitators" in one.own and "imitators" in two.own, "of two trainings one is there"


def test_what_follows_from_a_failed_stage_is_left_out(experiment):
    (run, *_) = plan(experiment())
    stages = run.stages(["imitation", "naive_gail"])
    clustering = next(stage for stage in stages if stage.name == "clustering")
    left = _without_what_follows(clustering, [stage for stage in stages if stage is not clustering])
    assert [stage.name for stage in left] == ["demonstrations", "naive_gail"]


def test_seeds(experiment):
    loaded = experiment(seeds=[7, 5, 6], row_seeds={"2:1": "20-24"})
    assert (loaded.seeds_of("1:2"), loaded.seeds_of("2:1")) == ((7, 5, 6), (20, 21, 22, 23, 24))
    few = loaded.with_seeds("2")
    assert (few.seeds_of("1:2"), few.seeds_of("2:1")) == ((7, 5), (20, 21))
    others = loaded.with_seeds("1-2")
    assert (others.seeds_of("1:2"), others.seeds_of("2:1")) == ((1, 2), (1, 2))
    for text in ("4", "0", "4-3", "a", "1-"):
        with pytest.raises(ConfigError, match=f"--seeds {text}: expected A-B"):
            loaded.with_seeds(text)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rowz": {}}, "unknown key 'rowz'; did you mean 'rows'?"),
        ({"measure": "returns"}, "measure: Input should be 'mean_return'"),
        ({"rows": {}}, "rows: Dictionary should have at least 1 item"),
        ({"seeds": "3-2"}, "seeds: .*at least 1 item"),
        (
            {"methods": ["imitation", "imitation"]},
            "experiment.yaml: two methods have the same name: imitation",
        ),
        ({"methods": ["gail"]}, "row '1:2': .*baselines: no policy 'gail'; there are exact_id"),
        ({"published": {"3:3": {}}}, "published: no row '3:3'; there are 1:2, 2:1"),
        ({"published": {"1:2": {"bc": 1}}}, "published: 1:2: no method 'bc'; there are imitation, naive_gail, kept"),
        ({"row_seeds": {"3:3": 1}}, "row_seeds: no row '3:3'"),
        ({"rows": {"a": ["clustering.num_cluster=3"]}}, "row 'a': .*did you mean 'num_clusters'?"),
        ({"rows": {"a:b": [], "a/b": []}}, "rows 'a:b' and 'a/b' would both have runs in a-b-seed3"),
        ({"run": "hoper"}, "hoper: no such file.*did you mean 'hopper'?"),
    ],
)
def test_what_cannot_be_is_refused_with_its_name(experiment, changes, message):
    with pytest.raises(ConfigError, match=message):
        plan(experiment(**changes))


def test_a_row_or_method_that_there_is_not(experiment, tmp_path):
    table = Table.of(experiment(), tmp_path)
    with pytest.raises(ConfigError, match="micro: no row '3:3'; there are 1:2, 2:1"):
        table.select(["3:3"], None)
    with pytest.raises(ConfigError, match="micro: no method 'oracle'; there are imitation, naive_gail, kept, plain"):
        table.select(None, ["oracle"])


def test_who_reached_the_goal():
    # Driving: 500 at the goal, -1100 in a crash, -1 a step; Panda: 1000, -1000, and the way of the box.
    lengths = np.array([600, 600, 1000])
    driving = reached_goal("oodil/Driving-v0", np.array([-100.0, -1700.0, -1000.0]), lengths, 1000)
    panda = reached_goal("oodil/Panda-v0", np.array([1010.0, -900.0, 300.0]), lengths, 1000)
    assert driving is not None and panda is not None
    assert driving.tolist() == panda.tolist() == [True, False, False]
    assert reached_goal("oodil/Hopper-v0", np.ones(3), lengths, 1000) is None
