"""The examples run as they are: as scripts without a ``__main__`` guard, and in a thread."""

import os
import re
import runpy
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

import oodil
from oodil.cli import app
from tests.runs import MICRO, ROOT

pytestmark = pytest.mark.timeout(300)
EXAMPLES = ROOT / "examples"


def test_the_quickstart_as_a_script_whose_jobs_run_in_other_processes(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / "quickstart.py"), str(MICRO), str(tmp_path / "run")]
    done = subprocess.run(command, cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    shown = done.stdout.splitlines()
    assert len(shown) == 7 + 2 and shown[0].startswith("demonstration"), "seven demonstrations, an episode, a policy"
    assert shown[-1].startswith("ours: return") and shown[-1].endswith("over 32 episodes")


def test_the_quickstart_in_a_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["quickstart.py", str(MICRO), str(tmp_path / "run")])
    seen: list[oodil.RunResults] = []
    thread = threading.Thread(target=lambda: seen.append(runpy.run_path(str(EXAMPLES / "quickstart.py"))["run"]))
    thread.start()
    thread.join()
    assert seen[0].is_done("imitation")


def test_a_method_of_ones_own_in_one_file(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / "own_weighting.py"), str(MICRO), str(tmp_path / "run")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == ["ours", "naive GAIL", "fast ones"]


def script(name: str, *arguments: object) -> list[str]:
    """Run an example from its own folder, as its reader does, and return its lines."""
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def carts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of the example with an environment and recordings of one's own, as small as it goes."""
    folder = tmp_path_factory.mktemp("carts")
    said = script("own_data.py", folder / "carts.safetensors")
    assert said == [f"{folder / 'carts.safetensors'}: 40 demonstrations of heavy cart, light cart"]
    sections = ("clustering", "transferability", "imitation", "evaluation", "runtime")
    small = yaml.safe_load(MICRO.read_text())
    overrides = [f"{name}={yaml.safe_dump(small[name], default_flow_style=True, width=9999)}" for name in sections]
    said = script("own_environment.py", folder / "carts.safetensors", folder / "run", *overrides)
    assert [line.partition(":")[0] for line in said[:2]] == ["heavy cart", "light cart"]
    assert re.fullmatch(r"after 5 s the cart is at -?\d+\.\d\d m", said[2])
    return folder


def test_an_environment_and_data_of_ones_own_and_data_that_come_later(carts: Path) -> None:
    said = script("score_new_data.py", carts / "run", carts / "carts.safetensors")
    assert len(said) == 40
    assert said[0].startswith("demonstration   0: transferability 0.")


def test_the_policy_elsewhere_in_the_lines_of_the_documentation(carts: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnxruntime")
    monkeypatch.chdir(carts)
    exported = CliRunner().invoke(app, ["export-policy", "run", "--onnx", "policy.onnx"])
    assert exported.output == ("policy.onnx: imitation, observation ['batch', 2] to action ['batch', 1], float32\n")
    (lines,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "elsewhere.md").read_text(), re.DOTALL)
    policy = oodil.open_run("run").policy()
    for place in (-3.0, 0.02, 3.0):
        scope = {"observation": np.array([place, 0.0])}
        exec(lines, scope)
        np.testing.assert_allclose(scope["actions"][0], policy.act(scope["observation"]), rtol=1e-5, atol=1e-5)


def test_a_policy_that_cannot_be_exported_is_named(
    carts: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(file: str, *options: str) -> str:
        result = CliRunner().invoke(
            app, ["export-policy", str(carts / "run"), "--onnx", str(tmp_path / file), *options]
        )
        assert result.exit_code == 2
        return result.output

    assert "no policy 'oracle'; this run has imitation" in refused("a.onnx", "--policy", "oracle")
    assert "ends in .onnx" in refused("a.json")
    assert "nowhere/a.onnx: No such file" in refused("nowhere/a.onnx")
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "oodil.pipeline.onnx_export", raising=False)
    assert "--onnx needs onnx; pip install 'oodil[onnx]'" in refused("a.onnx")
    assert not list(tmp_path.iterdir())
