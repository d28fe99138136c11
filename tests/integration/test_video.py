"""Filming a policy, where something can be rendered."""

import ctypes.util
import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as imageio
import pytest

from tests.runs import ROOT

PROGRAM = """
import sys
from pathlib import Path
from oodil.pipeline.evaluation import film
from oodil.pipeline.environments import environment_spec
from oodil.pipeline.results import Policy
from oodil.pipeline.stages.experts import load_expert
expert, _ = load_expert(Path("configs/experts/hopper-gravity-9.8"))
spec = environment_spec("oodil/Hopper-v0", {})
policy = Policy(expert, "oodil/Hopper-v0", spec.observation_shape, spec.action_low, spec.action_high)
print(film(policy, "oodil/Hopper-v0", {"gravity": 9.8}, 0, Path(sys.argv[1])))
"""


def film(path: Path, backend: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, str(path)],
        cwd=ROOT,
        env=os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
        capture_output=True,
        text=True,
        timeout=200,
    )


@pytest.mark.skipif(not ctypes.util.find_library("OSMesa"), reason="OSMesa is not installed; .ci/run installs it")
def test_a_film_shows_something_that_moves(tmp_path: Path) -> None:
    done = film(tmp_path / "film.mp4", "osmesa")
    assert done.returncode == 0, done.stderr
    frames = imageio.imread(tmp_path / "film.mp4")
    assert len(frames) == 250
    assert frames[0].std() > 10
    assert abs(frames[100].astype(int) - frames[0].astype(int)).mean() > 1


def test_what_cannot_be_rendered_says_what_is_missing(tmp_path: Path) -> None:
    done = film(tmp_path / "film.mp4", "disabled")
    assert done.returncode != 0
    assert "cannot render here" in done.stderr and "libosmesa6" in done.stderr
