"""Presets of a whole run: what they set, what stays above them, and the table of the docs that lists them."""

from pathlib import Path
from typing import Any, get_args

import pytest
import yaml

from oodil.pipeline.config import CLUSTERING_PRESETS, PRESETS, PpoConfig, RunConfig
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.loading import load_config, shipped_configs

PAGE = Path(__file__).parents[2] / "docs" / "presets.md"
MINIMAL: dict[str, Any] = {
    "name": "test",
    "environment": {"id": "oodil/Hopper-v0"},
    "demonstrations": {"file": "demonstrations"},
    "transferability": {"gail": {"total_steps": 1000}},
    "imitation": {"gail": {"total_steps": 2000}},
}


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return what nested sections hold, by dotted names."""
    found = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def resolved(*overrides: str) -> dict[str, Any]:
    return flat(load_config(MINIMAL, overrides).model_dump(mode="json"))


def test_presets_have_one_set_of_names() -> None:
    named = get_args(get_args(RunConfig.model_fields["preset"].annotation)[0])
    assert list(named) == list(PRESETS) == list(CLUSTERING_PRESETS)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_sets_the_whole_run_and_its_clustering(name: str) -> None:
    config = load_config(MINIMAL, [f"preset={name}"])
    assert config.preset == name
    assert config.clustering == load_config(MINIMAL, [f"clustering.preset={name}"]).clustering
    for gail in (config.transferability.gail, config.imitation.gail):
        assert (gail.discriminator.view, gail.discriminator.gradient_penalty) == ("raw", 0)
        assert (gail.discriminator.steps_per_iteration, gail.final_std, gail.anneal) == (1, None, False)
    assert (config.transferability.reading.discriminator, config.transferability.kept_from) == ("last", 0)
    assert (config.transferability.num_trainings, config.imitation.num_trainings) == (1, 1)
    assert config.imitation.num_candidates == 1
    steps = config.imitation.gail.steps_per_iteration
    assert -(-steps // config.imitation.gail.value.minibatch_size) == 30


@pytest.mark.parametrize("path", shipped_configs().values(), ids=shipped_configs())
@pytest.mark.parametrize("name", PRESETS)
def test_every_shipped_configuration_has_every_preset_and_keeps_what_it_says(path: Path, name: str) -> None:
    plain, preset = load_config(path), load_config(path, [f"preset={name}"])
    assert preset.transferability.reading.discriminator == "last"
    for each in ("num_clusters", "subtrajectory_length"):
        assert getattr(preset.clustering, each) == getattr(plain.clustering, each)
    assert preset.imitation.gail.total_steps == plain.imitation.gail.total_steps
    assert (preset.environment, preset.demonstrations) == (plain.environment, plain.demonstrations)


def test_what_is_said_stays_above_a_preset() -> None:
    said = {
        "clustering.label_draws": 3,
        "transferability.kept_from": 0.5,
        "transferability.gail.policy_optimizer.max_kl": 0.02,
        "transferability.reading.steps": 10,
        "imitation.gail.discriminator.view": "change",
        "imitation.num_trainings": 2,
    }
    changed = resolved("preset=paper", *(f"{key}={value}" for key, value in said.items()))
    assert changed == resolved("preset=paper") | said
    other = load_config(MINIMAL, ["preset=paper", "imitation.gail.policy_optimizer.kind=ppo"])
    assert other.imitation.gail.policy_optimizer == PpoConfig(), "a section of another kind has none of its fields"
    mixed = load_config(MINIMAL, ["preset=paper", "clustering.preset=official"])
    assert mixed.clustering == load_config(MINIMAL, ["preset=official"]).clustering


def test_a_preset_of_what_is_already_made_is_refused() -> None:
    config = load_config(MINIMAL, ["preset=paper"])
    assert load_config(config, ["seed=3"]) == config.model_copy(update={"seed": 3})
    for key in ("preset", "clustering.preset"):
        with pytest.raises(ConfigError, match=f"override '{key}=official': a configuration that is made"):
            load_config(config, [f"{key}=official"])


@pytest.mark.parametrize("value", ["offical", "[paper]", "7"])
def test_a_preset_that_is_none_is_named(value: str) -> None:
    with pytest.raises(ConfigError, match="preset: Input should be 'paper' or 'official', got "):
        load_config(MINIMAL, [f"preset={value}"])


def test_the_table_of_the_docs_is_that_of_the_code() -> None:
    """Every row is right, and no field that a preset changes is left out."""
    columns = [resolved(), *(resolved(f"preset={name}") for name in PRESETS)]
    lines = [line.strip("| \n").split(" | ") for line in PAGE.read_text().splitlines() if line.startswith("| `")]
    listed = {}
    for name, *cells in lines:
        key = name.strip("`")
        sections = ("transferability.", "imitation.") if key.startswith("gail.") else ("",)
        listed |= {f"{section}{key}": [yaml.safe_load(cell) for cell in cells] for section in sections}
    found = {key: [column[key] for column in columns] for key in columns[0] if key != "preset"}
    assert listed == {key: found[key] for key in listed}
    assert {key for key, values in found.items() if len({str(value) for value in values}) > 1} <= set(listed)
