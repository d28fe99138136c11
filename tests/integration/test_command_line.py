"""Bad input: one clear message and exit code 2, before any work starts."""

import fcntl
import json
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import yaml
from typer.testing import CliRunner

import oodil
from oodil.cli import app
from oodil.cli.doctor import EXTRAS
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.datasets import encode_demonstrations
from oodil.pipeline.loading import load_config
from tests.runs import MICRO, ROOT

HOPPER = "oodil/Hopper-v0"


def refused(*arguments: str) -> str:
    """Return the message of a command that must exit with code 2."""
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == 2, (result.exit_code, result.output, result.exception)
    return result.output


def arrays(lengths: tuple[int, ...] = (5, 4), dim: int = 12) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "observations": rng.standard_normal((sum(lengths), dim), dtype=np.float32),
        "offsets": np.cumsum([0, *lengths]).astype(np.int64),
    }


@pytest.fixture
def config_for(tmp_path: Path):
    """Return a function that writes a configuration for a file of demonstrations."""

    def write(content: bytes) -> tuple[Path, Path]:
        values = yaml.safe_load(MICRO.read_text())
        values["demonstrations"] = {"file": "given.safetensors"}
        values["baselines"] = []
        (tmp_path / "given.safetensors").write_bytes(content)
        (tmp_path / "config.yaml").write_text(yaml.safe_dump(values))
        return tmp_path / "config.yaml", tmp_path / "given.safetensors"

    return write


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("clustering.num_cluster=3", "unknown key 'clustering.num_cluster'; did you mean 'num_clusters'?"),
        ("sed=3", "unknown key 'sed'; did you mean 'seed'?"),
        ("imitation.gail.policy_optimizer.max_kll=1", "did you mean 'max_kl'?"),
        ("seed=soon", "seed: Input should be a valid integer"),
        ("clustering.temperature=-1", "clustering.temperature: Input should be greater than 0, got -1"),
        ("clustering.preset=[paper]", "clustering: preset is ['paper']; there are paper, official"),
        ("demonstrations.sources.2.count=5", "2 is not an entry of the list, which has 0 to 1"),
        ("environment.id=oodil/Hoper-v0", "oodil/Hoper-v0"),
        ("environment={id: CartPole-v1}", "the action space is Discrete(2); only Box spaces can be used"),
        ("environment.dynamics.gravty=9", "gravty"),
        ("environment.dynamics.gravity=-9", "gravity is -9.0; it must be positive"),
        ("imitation.gail.discriminator.ignored=[12]", "unknown key 'imitation.gail.discriminator.ignored'"),
        ("imitation.gail.discriminator.view=speed", "view: Input should be 'change' or 'raw', got 'speed'"),
        ("nonsense", "not of the form key=value"),
    ],
)
def test_configuration(tmp_path: Path, override: str, message: str) -> None:
    output = refused("run", str(MICRO), override, "--run-dir", str(tmp_path / "run"))
    assert message in output
    assert len(output.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_shipped_configurations_are_listed_and_copied(tmp_path: Path) -> None:
    listed = CliRunner().invoke(app, ["configs"]).output
    assert all(name in listed for name in ("quickstart", "hopper", "quick/driving"))
    copied = CliRunner().invoke(app, ["configs", "--copy", str(tmp_path / "mine")])
    assert copied.exit_code == 0, copied.output
    assert load_config(tmp_path / "mine" / "smoke.yaml") != load_config("smoke"), "experts are those of the copy"
    assert "exists already" in refused("configs", "--copy", str(tmp_path / "mine"))
    assert "did you mean 'hopper'?" in refused("run", "hoper", "--run-dir", str(tmp_path / "run"))


def test_a_defect_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what the user can mend becomes a message; a missing key in our own code does not."""

    def broken(*_: object) -> None:
        raise KeyError("weights")

    monkeypatch.setattr("oodil.orchestrator.check_inputs", broken)
    result = CliRunner().invoke(app, ["run", str(MICRO)])
    assert isinstance(result.exception, KeyError) and result.exit_code == 1


def test_configuration_file_that_is_missing_or_no_mapping(tmp_path: Path) -> None:
    assert "nowhere.yaml: no such file" in refused("run", str(tmp_path / "nowhere.yaml"))
    (tmp_path / "list.yaml").write_text("- 1\n")
    assert "expected a mapping" in refused("run", str(tmp_path / "list.yaml"))


def test_missing_expert(tmp_path: Path) -> None:
    shutil.copy(MICRO, tmp_path / "micro.yaml")
    assert "no expert is saved here" in refused("run", str(tmp_path / "micro.yaml"), "--run-dir", str(tmp_path / "run"))


def with_nan() -> bytes:
    made = arrays()
    made["observations"][6, 3] = np.nan
    return safetensors.numpy.save(made)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (safetensors.numpy.save(arrays())[:-30], "truncated"),
        (b"", "truncated"),
        (with_nan(), "demonstration 1 has the value nan in state 1"),
        (safetensors.numpy.save(arrays(dim=11)), "states have 11 dimensions; environment oodil/Hopper-v0 has 12"),
        (safetensors.numpy.save(arrays((5, 1))), "demonstration 1 has 1 state(s); a transition needs at least 2"),
        (safetensors.numpy.save({"observations": arrays()["observations"]}), "has no array 'offsets'"),
    ],
)
def test_demonstration_files(config_for, tmp_path: Path, content: bytes, message: str) -> None:
    config, file = config_for(content)
    output = refused("run", str(config), "--run-dir", str(tmp_path / "run"))
    assert message in output and str(file) in output
    assert not (tmp_path / "run").exists()


def test_a_file_recorded_in_another_environment(config_for, tmp_path: Path) -> None:
    made = arrays()
    recorded = Demonstrations(
        **made,
        sources=np.zeros(2, np.int32),
        source_labels=("other",),
        returns=np.full(2, np.nan),
        terminated=np.zeros(2, np.bool_),
    )
    config, _ = config_for(encode_demonstrations(recorded, "oodil/Walker2d-v0"))
    assert "recorded in oodil/Walker2d-v0" in refused("run", str(config), "--run-dir", str(tmp_path / "run"))


def test_a_run_directory_of_another_run(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    (run_dir / "thesis.tex").write_text("not ours")
    assert "is not empty and not a run" in refused("run", str(MICRO), "--run-dir", str(run_dir))
    assert "is a file" in refused("run", str(MICRO), "--run-dir", str(run_dir / "thesis.tex"))
    shutil.rmtree(run_dir)
    result = CliRunner().invoke(
        app, ["run", str(MICRO), "--run-dir", str(run_dir), "--workers", "0", "--until", "demonstrations"]
    )
    assert result.exit_code == 0, result.output
    assert "holds a run with seed 0, not 1" in refused("run", str(MICRO), "seed=1", "--run-dir", str(run_dir))
    smoke = str(ROOT / "configs" / "smoke.yaml")
    assert 'holds a run with name "micro", not "smoke"' in refused("run", smoke, "--run-dir", str(run_dir))
    assert "no stage 'clustring'" in refused("resume", str(run_dir), "--until", "clustring")
    with open(run_dir / ".lock") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert "another process is working on this run" in refused("resume", str(run_dir))
        # Its jobs read the configuration whenever one begins, so it must not change under them.
        before = (run_dir / "config.json").read_bytes()
        changed = refused("run", str(MICRO), "imitation.gail.total_steps=9600", "--run-dir", str(run_dir))
        assert "another process is working on this run" in changed
        assert (run_dir / "config.json").read_bytes() == before
    described = json.loads(CliRunner().invoke(app, ["status", str(run_dir), "--json"]).output)
    assert described["stages"]["demonstrations"]["state"] == "done"
    assert described["stages"]["imitation"]["state"] == "pending"
    shown = CliRunner().invoke(app, ["demos", "inspect", str(run_dir)]).output
    assert "7 demonstrations" in shown and "fast" in shown and "slow" in shown


def test_what_would_not_be_computed_is_not_forced(tmp_path: Path) -> None:
    words = "run", str(MICRO), "--run-dir", str(tmp_path / "run"), "--until", "clustering", "--force", "imitation"
    assert "--force imitation: comes after --until clustering" in refused(*words)
    assert not (tmp_path / "run").exists()


def test_places_where_nothing_can_be_written(tmp_path: Path) -> None:
    file = tmp_path / "thesis.tex"
    file.write_text("not ours")
    assert f"{file}/allowed: Not a directory" in refused("keys", "new", str(file))
    for output, message in ((file, "are written as FILE.safetensors"), (tmp_path / "no" / "a.safetensors", "no such")):
        assert message in refused("demos", "collect", str(MICRO), "--output", str(output))
    (tmp_path / "a.safetensors").mkdir()
    assert "is a folder" in refused("demos", "collect", str(MICRO), "--output", str(tmp_path / "a.safetensors"))


def test_a_worker_needs_an_address(tmp_path: Path) -> None:
    assert "cannot connect to 'nonsense'" in refused("worker", "--connect", "nonsense", "--keys", str(tmp_path))


@pytest.mark.parametrize("option", ["--until", "--force"])
def test_a_stage_that_is_not_there_is_refused_before_anything_is_written(tmp_path: Path, option: str) -> None:
    output = refused("run", str(MICRO), "--run-dir", str(tmp_path / "run"), option, "transfer")
    assert "no stage 'transfer'; this run has demonstrations, clustering, imitators, transferability, imit" in output
    assert not (tmp_path / "run").exists()


def test_version_help_and_completion(monkeypatch: pytest.MonkeyPatch) -> None:
    assert CliRunner().invoke(app, ["--version"]).output == f"oodil {oodil.__version__}\n"
    helped = CliRunner().invoke(app, [])
    assert helped.exit_code == 0 and "doctor" in helped.output
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    completed = CliRunner().invoke(
        app,
        [],
        prog_name="oodil",
        env={"_OODIL_COMPLETE": "complete_bash", "COMP_WORDS": "oodil do", "COMP_CWORD": "1"},
    )
    assert completed.output.split() == ["doctor"]


def test_the_doctor_looks_at_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("oodil.cli.doctor.FREE_GB", 1e9)
    monkeypatch.chdir(tmp_path)
    found = json.loads(CliRunner().invoke(app, ["doctor", "--json"]).output)
    names = {"version", "libraries", "extras", "cores", "threads", "GPU", "simulator", "Ray", "disk", "rendering"}
    assert set(found) == names
    assert (found["version"]["state"], found["libraries"]["state"]) == ("ok", "ok")
    assert found["disk"]["state"] == "attention" and str(tmp_path) in found["disk"]["found"]
    assert "--run-dir" in found["disk"]["advice"]
    assert found["GPU"]["state"] == "ok" and "not used" in found["GPU"]["found"]


def test_the_doctor_knows_all_extras() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert EXTRAS.keys() == extras.keys() - {"docs", "test"}


def test_the_doctor_goes_on_when_something_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> float:
        raise RuntimeError("no simulator here\nand a second line")

    monkeypatch.setattr("oodil.estimate.hopper_seconds", broken)
    output = CliRunner().invoke(app, ["doctor"]).output
    assert "attention  rate         RuntimeError: no simulator here\n" in output
    assert "disk" in output and "rendering" in output


def test_what_is_no_run(tmp_path: Path) -> None:
    for command in ("status", "resume", "report", "evaluate"):
        assert "is not a run" in refused(command, str(tmp_path))


def test_a_folder_that_cannot_be_made_and_a_file_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    inside = str(tmp_path / "file" / "run")
    assert f"{inside}: Not a directory" in refused("run", str(MICRO), "--run-dir", inside)
    np.savez(tmp_path / "states.npz", *np.zeros((2, 5, 12), np.float32))
    target = tmp_path / "file" / "out.safetensors"
    convert = ("demos", "convert", str(tmp_path / "states.npz"), "--environment", HOPPER, "--output", str(target))
    assert f"{target.parent}: no such folder" in refused(*convert)


def test_a_damaged_artifact_is_one_message(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    until = ("--run-dir", str(run_dir), "--workers", "0", "--until", "demonstrations")
    result = CliRunner().invoke(app, ["run", str(MICRO), *until])
    assert result.exit_code == 0, result.output
    (file,) = (run_dir / "stages" / "demonstrations").glob("*.safetensors")
    file.write_bytes(file.read_bytes()[:-1])
    assert "demonstrations is damaged" in refused("demos", "inspect", str(run_dir))
    (run_dir / "config.json").write_text("{")
    assert "config.json: cannot be read" in refused("status", str(run_dir))


def test_demonstrations_are_collected_into_a_file_and_not_twice(tmp_path: Path) -> None:
    output = tmp_path / "both.safetensors"
    words = ["demos", "collect", str(MICRO), "--output", str(output), "--workers", "0"]
    first = CliRunner().invoke(app, words)
    assert first.exit_code == 0 and "7 demonstrations" in first.output, first.output
    content, events = output.read_bytes(), tmp_path / f".{output.name}.run" / "events.jsonl"
    output.unlink()
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 0 and output.read_bytes() == content
    assert events.read_text().count('"stage_finished"') == 1, "what is collected is reused"
    other = CliRunner().invoke(app, [*words, "demonstrations.sources.0.count=2"])
    assert other.exit_code == 0 and "6 demonstrations" in other.output, other.output
    held, environment = oodil.read_demonstrations(output)
    assert (len(held), held.source_labels, environment) == (6, ("fast", "slow"), "oodil/Hopper-v0")
