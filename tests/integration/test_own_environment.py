"""An environment in a file beside the configuration, through every kind of process, and what is refused at once."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import yaml

from oodil import api
from oodil.pipeline.environments import make_batch
from oodil.pipeline.errors import StorageError, UnfinishedError
from oodil.pipeline.loading import load_config
from oodil.workers.channels import EndpointError
from oodil.workers.local_engine import LocalEngine
from tests.runs import MICRO, ROOT

pytestmark = pytest.mark.timeout(300)
MODULE = "home_made"
ENV_ID = f"{MODULE}:odd/Newtons-v0"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with an environment, demonstrations and a configuration, whose environment is in newtons."""
    (tmp_path / f"{MODULE}.py").write_text((ROOT / "tests" / "odd_environments.py").read_text())
    batch = make_batch("tests.odd_environments:odd/Newtons-v0", {}, 6)
    for g in range(6):
        batch.reset(g, seed=g)
    rows = []
    for t in range(40):
        rows.append(batch.observations())
        batch.step(np.full((6, 3), np.sin(t)))
    states = np.stack(rows, axis=1).reshape(-1, 6).astype(np.float32)
    arrays = {"observations": states, "offsets": np.arange(0, 241, 40)}
    safetensors.numpy.save_file(arrays, tmp_path / "mine.safetensors")
    values = yaml.safe_load(MICRO.read_text())
    values |= {"environment": {"id": ENV_ID, "dynamics": {}}, "baselines": []}
    values["demonstrations"] = {"file": "mine.safetensors"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(values))
    return tmp_path


def oodil(*arguments: str, cwd: Path, **environment: str) -> tuple[int, str]:
    """Run the command line as it is installed, with neither the current folder nor the tests on its path."""
    code = "import sys; sys.path.remove(''); from oodil.cli import main; main()"
    found = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src"), "NO_COLOR": "1"} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    return found.returncode, found.stdout


def test_a_module_beside_the_configuration_is_found_in_every_process(folder: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    run_dir = str(elsewhere / "run")
    until = ("--until", "clustering")
    code, output = oodil(
        "run", str(folder / "mine.yaml"), "--run-dir", run_dir, "--workers", "0", *until, cwd=elsewhere
    )
    assert code == 0, output
    assert "no finite bounds for action 2: learned as they are" in output.replace("\n", " ")
    code, output = oodil("resume", run_dir, "--workers", "1", cwd=elsewhere)
    assert code == 0, output
    code, output = oodil("evaluate", run_dir, "--episodes", "2", cwd=elsewhere)
    assert code == 0 and "length 60" in output, output


def test_a_conversion_finds_the_module_in_the_current_folder_or_beside_what_it_writes(folder: Path) -> None:
    np.savez(folder / "mine.npz", *np.zeros((2, 9, 6)))
    (folder / "elsewhere").mkdir()
    for at, source, output in (
        (folder, "mine.npz", "elsewhere/all.safetensors"),
        (folder / "elsewhere", "../mine.npz", "../all.safetensors"),
    ):
        code, said = oodil("demos", "convert", source, "--environment", ENV_ID, "--output", output, cwd=at)
        assert code == 0 and (at / output).is_file(), said
    code, said = oodil("demos", "convert", "../mine.npz", "--environment", ENV_ID, cwd=folder / "elsewhere")
    assert code == 2 and f"{MODULE} has to lie" in said and "in the current folder" in said


def test_modules_of_general_names_on_the_path_do_no_harm(folder: Path) -> None:
    for name in ("workers", "pipeline", "terminal", "orchestrator", "configs", "cli", "api", "bench"):
        (folder / f"{name}.py").write_text("raise ImportError('not yours')")
    path = os.pathsep.join((str(folder), str(ROOT / "src")))
    code, output = oodil("run", "mine.yaml", "--until", "clustering", "--workers", "1", cwd=folder, PYTHONPATH=path)
    assert code == 0, output


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["clustering.num_clusters=7"],
            "6 demonstrations cannot form 7 clusters; give more, or a smaller clustering.num_clusters",
        ),
        ([f"environment.id={MODULE}:odd/Broadcast-v0"], "observes an array of shape (2,), but its observation space"),
        ([f"environment.id={MODULE}:odd/LateDraw-v0"], "is not deterministic"),
        (["environment.dynamics.weight=3"], "does not take the dynamics {'weight': 3}"),
    ],
)
def test_it_is_refused_before_any_work(folder: Path, overrides: list[str], message: str) -> None:
    code, output = oodil("run", "mine.yaml", *overrides, cwd=folder)
    assert code == 2 and message in output and "Traceback" not in output, output
    assert not (folder / "runs").exists()


def test_a_long_folder_for_temporary_files_is_refused_before_any_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    long = folder / ("project-" * 8) / ("job-" * 8)
    long.mkdir(parents=True)
    monkeypatch.setattr("tempfile.tempdir", str(long))
    with pytest.raises(EndpointError, match="too long for a socket; set TMPDIR"):
        LocalEngine(1)
    LocalEngine(0)
    code, output = oodil("run", "mine.yaml", "--workers", "2", cwd=folder, TMPDIR=str(long))
    assert code == 2 and "set TMPDIR" in output and not (folder / "runs").exists(), output


def test_a_disk_without_room_for_the_demonstrations_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from oodil.orchestrator import open_run

    class Usage:
        free = 1000

    monkeypatch.setattr("shutil.disk_usage", lambda path: Usage)
    with pytest.raises(StorageError, match=r"0\.0 MiB are free, and a copy of .*mine\.safetensors alone has"):
        open_run(folder / "run", load_config(folder / "mine.yaml"))


def test_what_is_found_later_ends_the_run_at_once(folder: Path) -> None:
    """Carts that a policy drives get where the trial did not, and the first episode that is over is played again."""
    said = "'home_made:odd/Far-v0' is not deterministic: an episode of 60 steps"
    far = ["environment.id=home_made:odd/Far-v0", "runtime.max_attempts=9", "transferability.gail.total_steps=40000"]
    for workers in (0, 2):
        with pytest.raises(UnfinishedError, match=said):
            api.run(folder / "mine.yaml", far, workers=workers, run_dir=folder / f"r{workers}")


def test_what_the_estimate_meets_is_one_message(folder: Path) -> None:
    """It plays more episodes than the trial; there the environment fails."""
    for name, message in (("Tired", "raised OSError: no more"), ("Blinded", "observation that is not finite")):
        environment, run_dir = f"environment.id={MODULE}:odd/{name}-v0", ("--run-dir", name)
        code, output = oodil("run", "mine.yaml", environment, "--workers", "0", *run_dir, cwd=folder)
        assert code == 2 and message in output and "Traceback" not in output, output
