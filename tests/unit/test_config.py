"""The configuration: every shipped file loads, and every mistake is answered by one line that helps."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel, ValidationError

import oodil.pipeline.config
from oodil.pipeline.config import (
    CLUSTERING_PRESETS,
    ClusteringConfig,
    ImitationConfig,
    PpoConfig,
    RunConfig,
    TrainingConfig,
    TransferabilityConfig,
    TrpoConfig,
)
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.loading import load_config, parse_config
from oodil.pipeline.stage import stage_named
from oodil.pipeline.stages import PolicyStage

ROOT = Path(__file__).parents[2]
SHIPPED = sorted((ROOT / "configs").glob("*.yaml"))
SOURCE = {"label": "heavy", "dynamics": {"gravity": 15.0}, "expert": "experts/heavy", "count": 3}


def values(**changes):
    return {
        "name": "test",
        "environment": {"id": "oodil/Hopper-v0", "dynamics": {"gravity": 12.0}},
        "demonstrations": {"sources": [SOURCE]},
        "transferability": {"gail": {"total_steps": 1000}},
        "imitation": {"gail": {"total_steps": 2000}},
    } | changes


@pytest.fixture
def write(tmp_path):
    def to_file(content):
        path = tmp_path / "config.yaml"
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
        return path

    return to_file


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_every_shipped_configuration_loads(path):
    config = load_config(path)
    assert config.name.replace("-", "_") == path.stem
    for source in config.demonstrations.sources:
        assert source.expert == "hand-written" or source.expert.parent == ROOT / "configs" / "experts"


def test_a_minimal_file_gets_the_defaults(write, tmp_path):
    config = load_config(write(values()))
    assert config.seed == 0
    assert config.clustering == ClusteringConfig()
    assert config.imitation.gail.policy_optimizer == TrpoConfig()
    assert config.demonstrations.sources[0].expert == tmp_path / "experts" / "heavy"


def test_a_resolved_configuration_reads_back_as_it_is(write):
    config = load_config(write(values(clustering={"preset": "official"}, baselines=["naive_gail"])))
    assert parse_config(json.loads(config.model_dump_json()), "resolved") == config


def test_overrides_reach_every_depth_and_are_typed(write):
    overrides = [
        "seed=7",
        "imitation.gail.policy_hidden=[32, 16]",
        "imitation.warm_start=false",
        "imitation.gail.policy_optimizer.kind=ppo",
        "imitation.gail.policy_optimizer.learning_rate=1e-3",
        "transferability.gail.policy_optimizer.max_kl=0.02",
        "clustering.num_clusters=1",
        "runtime.workers=0",
        "environment.dynamics.gravity=9.8",
        "demonstrations.sources.0.count=500",
        "demonstrations.sources.0.dynamics.gravity=2.0",
        "name=a-b",
    ]
    config = load_config(write(values()), overrides)
    assert config.seed == 7 and config.imitation.warm_start is False
    assert config.imitation.gail.policy_hidden == (32, 16)
    assert config.imitation.gail.policy_optimizer == PpoConfig(learning_rate=1e-3)
    assert config.transferability.gail.policy_optimizer == TrpoConfig(max_kl=0.02)
    assert (config.clustering.num_clusters, config.runtime.workers, config.name) == (1, 0, "a-b")
    assert config.environment.dynamics == {"gravity": 9.8}
    assert config.demonstrations.sources[0].count == 500
    assert config.demonstrations.sources[0].dynamics == {"gravity": 2.0}


def test_a_shipped_configuration_is_found_by_its_name_and_plain_values_are_one_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_config("hopper") == load_config(ROOT / "configs" / "hopper.yaml") == load_config("hopper.yaml")
    assert load_config("quick/driving", ["seed=2"]).seed == 2
    with pytest.raises(ConfigError, match=r"hoper: no such file, and no configuration .*did you mean 'hopper'\?"):
        load_config("hoper")
    given = values()
    config = load_config(given, ["seed=3"])
    assert config.seed == 3 and given == values(), "the caller's values are left alone"
    assert config.demonstrations.sources[0].expert == tmp_path / "experts" / "heavy"
    assert load_config(config, ["seed=4"]) == config.model_copy(update={"seed": 4})


def test_an_override_wins_over_the_file_and_the_last_one_wins(write):
    assert load_config(write(values(seed=1)), ["seed=2", "seed=3"]).seed == 3


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed", "'seed' is not of the form key=value"),
        ("=3", "'=3' is not of the form key=value"),
        ("seed.deeper=3", "seed is not a section"),
        ("demonstrations.sources.count=3", "count is not an entry of the list, which has 0 to 0"),
        ("demonstrations.sources.1.count=3", "1 is not an entry of the list, which has 0 to 0"),
        ("demonstrations.sources.-1.count=3", "-1 is not an entry of the list, which has 0 to 0"),
        ("baselines.0=oracle", "0 is not an entry of the list, which is empty"),
        ("seed=[1", r"'seed=\[1': the value is not valid YAML"),
        ("sed=3", "unknown key 'sed'; did you mean 'seed'"),
        ("runtime.wokers=3", "unknown key 'runtime.wokers'; did you mean 'workers'"),
    ],
)
def test_bad_overrides_are_refused(write, override, message):
    with pytest.raises(ConfigError, match=message):
        load_config(write(values(seed=1, baselines=[])), [override])


def keys(section, prefix=""):
    """Yield the key of every field, sections included."""
    for name, field in section.model_fields.items():
        yield f"{prefix}{name}"
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from keys(field.annotation, f"{prefix}{name}.")


ODD_VALUES = ["[]", "[paper]", "[[1]]", "[null]", "{}", "{a: 1}", "{1: 2}", "null", "x", "''", "-1", ".nan", "1e400"]
ODD_VALUES += ["true", "2020-01-01", "!!set {a}", "!!binary aaaa", "99999999999999999999999"]


@pytest.mark.parametrize("key", [*keys(RunConfig), "demonstrations.sources.0.dynamics", "clustering.preset"])
def test_a_value_of_any_type_is_taken_or_refused(key):
    """No value of a wrong type ends in anything but a message, wherever it stands."""
    for value in ODD_VALUES:
        with contextlib.suppress(ConfigError):
            load_config(values(), [f"{key}={value}"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"enviroment": {}}, "config: unknown key 'enviroment'; did you mean 'environment'"),
        ({"clustering": {"num_cluster": 3}}, "unknown key 'clustering.num_cluster'; did you mean 'num_clusters'"),
        (
            {"imitation": {"gail": {"total_steps": 1, "gamma": 0.9}}},
            r"unknown key 'imitation\.gail\.gamma'; (did you mean|valid keys: .*discount)",
        ),
        (
            {"imitation": {"gail": {"total_steps": 1, "policy_optimizer": {"kind": "ppo", "clp": 0.1}}}},
            r"unknown key 'imitation\.gail\.policy_optimizer\.clp'; did you mean 'clip'",
        ),
        (
            {"demonstrations": {"sources": [SOURCE | {"cuont": 3}]}},
            r"unknown key 'demonstrations\.sources\.0\.cuont'; did you mean 'count'",
        ),
        ({"zzz": 1}, "unknown key 'zzz'; valid keys: .*baselines.*seed"),
        ({"seed": "many"}, "seed: Input should be a valid integer.*got 'many'"),
        ({"seed": -1}, "seed: .*greater than or equal to 0, got -1"),
        ({"name": "a b"}, "name: .*got 'a b'"),
        ({"name": "../up"}, "name: .*got '../up'"),
        ({"imitation": {"gail": {}}}, "imitation.gail.total_steps: required, but missing"),
        ({"imitation": {"gail": {"total_steps": 0}}}, "imitation.gail.total_steps: .*greater than 0, got 0"),
        ({"imitation": {"gail": {"total_steps": 9, "lag": 2}}}, "imitation.gail.lag: .*0 or 1, got 2"),
        ({"imitation": {"gail": {"total_steps": 9, "discount": 1.5}}}, "discount: .*less than 1, got 1.5"),
        ({"imitation": {"gail": {"total_steps": 9, "policy_hidden": []}}}, "policy_hidden: .*at least 1"),
        ({"imitation": {"gail": {"total_steps": 9, "initial_log_std": float("nan")}}}, "finite number, got nan"),
        (
            {"imitation": {"gail": {"total_steps": 9, "policy_optimizer": {"kind": "sac"}}}},
            "policy_optimizer: .*sac.*'trpo', 'ppo'",
        ),
        ({"environment": {"dynamics": {"gravity": "low"}}}, "environment.dynamics: gravity .*number.*got 'low'"),
        ({"environment": {"dynamics": {"gravity": float("inf")}}}, "environment.dynamics.gravity.*finite.*got inf"),
        ({"clustering": {"preset": ["paper"]}}, r"clustering: preset is \['paper'\]; there are paper, official"),
        ({"clustering": {"preset": "offical"}}, "clustering: preset is 'offical'; there are paper, official"),
        ({"clustering": {"update_order": "both"}}, "clustering.update_order: .*step_first.*got 'both'"),
        ({"clustering": []}, "clustering: "),
        ({"demonstrations": {}}, "demonstrations: give either file or sources"),
        ({"demonstrations": {"file": "a", "sources": [SOURCE]}}, "demonstrations: give either file or sources"),
        ({"demonstrations": {"sources": [SOURCE, SOURCE]}}, "two sources have the same label"),
        (
            {"demonstrations": {"sources": [SOURCE], "transferable": ["a"]}},
            "labels, transferable and unmarked are for a file",
        ),
        (
            {"imitation": {"gail": {"total_steps": 1, "policy_hidden": [32]}}},
            r"imitation.gail.policy_hidden is \[32\]; transferability.gail, .*warm_start is false, has \[64, 64\]",
        ),
        ({"baselines": ["oracle_target"]}, "learns from an expert of the imitator's own dynamics; name one"),
        ({"baselines": ["oracle"]}, "the oracle needs sources that are marked transferable"),
        (
            {"baselines": ["bc"]},  # Where tests.toy was imported before, far is known, too.
            "config: baselines: no policy 'bc'; there are exact_id, f_mdp, f_mdp_per_source, (far, )?id_gail",
        ),
        ({"runtime": {"workers": -1}}, "runtime.workers: .*greater than or equal to 0, got -1"),
    ],
)
def test_mistakes_are_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        parse_config(values(**changes), "config")


def test_every_mistake_gets_its_own_line():
    with pytest.raises(ConfigError) as caught:
        parse_config(values(seed="x", sed=1, name="a b"), "file.yaml")
    lines = str(caught.value).splitlines()
    assert len(lines) == 3
    assert all(line.startswith("file.yaml: ") for line in lines)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "expected a mapping of keys, found NoneType"),
        ("[1, 2]", "expected a mapping of keys, found list"),
        ("a: [1", "not valid YAML"),
        ("!!python/object/apply:os.getcwd []", "not valid YAML"),
    ],
)
def test_files_that_are_no_configuration_are_named(write, content, message):
    with pytest.raises(ConfigError, match=rf"config\.yaml: .*{message}"):
        load_config(write(content))


def test_binary_and_missing_files_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"gone\.yaml: no such file"):
        load_config(tmp_path / "gone.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ConfigError, match=r"binary\.yaml: not valid YAML"):
        load_config(tmp_path / "binary.yaml")


@pytest.mark.parametrize("name", CLUSTERING_PRESETS)
def test_a_preset_can_be_changed_in_parts(name):
    preset = ClusteringConfig.model_validate({"preset": name})
    changed = ClusteringConfig.model_validate({"preset": name, "label_draws": 3})
    for key, value in CLUSTERING_PRESETS[name].items():
        assert getattr(preset, key) == value
        assert getattr(preset, key) != getattr(ClusteringConfig(), key), "the preset repeats the default"
    assert changed == preset.model_copy(update={"label_draws": 3})


def test_a_configuration_cannot_be_changed():
    config = parse_config(values(), "config")
    with pytest.raises(ValidationError, match="frozen"):
        config.seed = 3


def test_iterations_round_up():
    config = TrainingConfig(total_steps=1001, num_groups=2, simulators_per_group=5, steps_per_rollout=10)
    assert (config.steps_per_iteration, config.num_iterations) == (100, 11)
    assert config.model_copy(update={"total_steps": 1000}).num_iterations == 10


def test_every_field_is_explained():
    sections = [
        value
        for name, value in vars(oodil.pipeline.config).items()
        if isinstance(value, type) and issubclass(value, BaseModel) and name.endswith("Config")
    ]
    assert len(sections) > 10
    silent = [
        f"{section.__name__}.{name}"
        for section in sections
        for name, field in section.model_fields.items()
        if not field.description and name != "kind"
    ]
    assert not silent


def test_reading_a_configuration_loads_no_heavy_library():
    """``--help`` and a wrong key answer at once."""
    probe = (
        "import sys, oodil.pipeline.config\n"
        "heavy = {'torch', 'mujoco', 'gymnasium', 'sklearn', 'scipy', 'zmq', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", probe], check=True, cwd=ROOT)


def test_discriminators_that_score_keep_learning_unless_told_otherwise() -> None:
    section = {"gail": {"total_steps": 10}}
    assert not TransferabilityConfig.model_validate(section).gail.anneal
    assert TransferabilityConfig.model_validate({"gail": {"total_steps": 10, "anneal": True}}).gail.anneal
    assert ImitationConfig.model_validate(section).gail.anneal


def test_naive_gail_can_have_all_the_steps_of_our_method():
    config = load_config("quickstart", ["imitation.num_trainings=3"])
    ours = config.cluster_steps + 3 * config.imitation.gail.total_steps
    stage = stage_named("naive_gail_all_steps")
    assert isinstance(stage, PolicyStage)
    assert ours <= 3 * stage.gail(config).total_steps < ours + 3
    assert config.cluster_steps == config.clustering.num_clusters * config.transferability.gail.total_steps
