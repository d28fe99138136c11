"""Filming a policy, where something can be rendered; and what is refused where it cannot."""

import ctypes.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import imageio.v3 as imageio
import numpy as np
import pytest
import safetensors.numpy
import yaml
from typer.testing import CliRunner

import oodil
from oodil.cli import app
from oodil.pipeline.environments import make_batch
from oodil.pipeline.environments.pictures import walker_of
from oodil.pipeline.errors import StorageError, UnusableEnvironmentError
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.filming import film, open_stage, strip
from oodil.pipeline.seeding import numpy_rng
from tests.runs import MICRO, ROOT

STRICT = "strict/Table-v0"
KEY = (5, 1)
needs_osmesa = pytest.mark.skipif(
    not ctypes.util.find_library("OSMesa"), reason="OSMesa is not installed; .ci/run installs it"
)


class Table(gymnasium.Env[Any, Any]):
    """A table of three rows is observed, and an action outside of its space is a mistake; rewards are the actions."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  (no render_fps)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Box(-9, 9, (3, 2), np.float32)
        self.action_space = gymnasium.spaces.Box(-0.5, 0.25, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.seen = self.np_random.uniform(-1, 1, (3, 2)).astype(np.float32)
        return self.seen, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.seen = np.float32(0.9) * np.roll(self.seen, 1, axis=0) + action
        return self.seen, float(action.sum()), False, False, {}

    def render(self) -> Any:
        return np.full((32, 48, 3), 100 + 10 * self.seen[0, 0], np.uint8)


class Blind(Table):
    """Has nothing to show."""

    def render(self) -> Any:
        return None


for _class in (Table, Blind):
    gymnasium.register(f"strict/{_class.__name__}-v0", entry_point=_class, max_episode_steps=12)


class Loud:
    """Wants more than the action space holds."""

    def mean(self, observations: Any) -> Any:
        assert observations.shape[1:] == (6,)
        return np.stack((observations[:, 0] - 5, observations[:, 5] + 5), axis=1).astype(np.float32)


def test_a_film_is_the_first_episode_of_an_evaluation(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    (expected,) = run_episodes(make_batch(STRICT, {}, 1), Loud(), numpy_rng(KEY), stochastic=False)
    assert film(Loud(), STRICT, {}, KEY, path) == expected.env_return == pytest.approx(12 * (-0.5 + 0.25))
    assert imageio.imread(path).shape == (13, 32, 48, 3)
    assert list(tmp_path.iterdir()) == [path]


def test_a_strip_has_the_first_and_the_last_frame() -> None:
    found = strip(Loud(), open_stage(STRICT, {}), KEY, 5)
    assert [step for step, _ in found.frames] == [0, 3, 6, 9, 12] and found.num_steps == 12
    seen = run_episodes(make_batch(STRICT, {}, 1), Loud(), numpy_rng(KEY), stochastic=False)[0].states
    for step, frame in found.frames:
        assert (frame == np.uint8(100 + 10 * seen[step, 0])).all()


def test_what_cannot_be_written_or_drawn_is_refused(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").mkdir()
    with pytest.raises(StorageError, match=r"film\.mp4: is a folder"):
        film(Loud(), STRICT, {}, KEY, tmp_path / "film.mp4")
    with pytest.raises(StorageError, match=r"missing/film\.mp4: No such file"):
        film(Loud(), STRICT, {}, KEY, tmp_path / "missing" / "film.mp4")
    with pytest.raises(
        UnusableEnvironmentError, match=r"Blind-v0' cannot be filmed: render\(\) gave NoneType; .*bytes$"
    ):
        film(Loud(), STRICT.replace("Table", "Blind"), {}, KEY, tmp_path / "blind.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


def test_what_is_not_installed_is_named_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "highway_env.road.graphics", None)
    with pytest.raises(UnusableEnvironmentError, match=r"not installed; pip install 'oodil\[driving\]'$"):
        film(Loud(), "oodil/Driving-v0", {}, KEY, tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


def test_a_film_that_cannot_be_written_ends_with_exit_code_2(tmp_path: Path) -> None:
    values = yaml.safe_load(MICRO.read_text())
    values |= {"environment": {"id": STRICT}, "baselines": [], "demonstrations": {"file": "states.safetensors"}}
    states = np.random.default_rng(0).standard_normal((60, 6), dtype=np.float32)
    arrays = {"observations": states, "offsets": np.arange(0, 61, 10)}
    safetensors.numpy.save_file(arrays, tmp_path / "states.safetensors")
    (tmp_path / "table.yaml").write_text(yaml.safe_dump(values))
    oodil.run(tmp_path / "table.yaml", workers=0, run_dir=tmp_path / "run")
    evaluate = ["evaluate", str(tmp_path / "run"), "--episodes", "2", "--video"]
    done = CliRunner().invoke(app, evaluate)
    assert done.exit_code == 0, done.output
    assert imageio.imread(tmp_path / "run" / "imitation.mp4").shape == (13, 32, 48, 3)
    page = oodil.write_report(oodil.open_run(tmp_path / "run")).read_text()
    assert page.count("data:image/jpeg;base64,") == 5 and "No film" not in page
    (tmp_path / "run" / "imitation.mp4").unlink()
    (tmp_path / "run" / "imitation.mp4").mkdir()
    refused = CliRunner().invoke(app, evaluate)
    assert refused.exit_code == 2 and "imitation.mp4: is a folder" in refused.output
    assert "return" not in refused.output


PROGRAM = """
import sys
from pathlib import Path
from oodil.pipeline.filming import film
from oodil.pipeline.stages.experts import load_expert
expert, _ = load_expert(Path("configs/experts/hopper-gravity-9.8"))
print(film(expert, "oodil/Hopper-v0", {"gravity": 9.8}, (0,), Path(sys.argv[1])))
"""


def in_a_process(backend: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
        capture_output=True,
        text=True,
        timeout=280,
    )


@needs_osmesa
def test_a_film_shows_something_that_moves(tmp_path: Path) -> None:
    done = in_a_process("osmesa", "-c", PROGRAM, str(tmp_path / "film.mp4"))
    assert done.returncode == 0, done.stderr
    frames = imageio.imread(tmp_path / "film.mp4")
    assert len(frames) == 251
    assert frames[0].std() > 10
    assert abs(frames[100].astype(int) - frames[0].astype(int)).mean() > 1


@needs_osmesa
@pytest.mark.parametrize("environment", ["oodil/Hopper-v0", "oodil/Panda20Hz-v0"])
def test_the_robot_is_in_every_frame(environment: str, tmp_path: Path) -> None:
    done = in_a_process("osmesa", "benchmarks/films.py", environment, "--json", str(tmp_path / "films.json"))
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((tmp_path / "films.json").read_text())["rows"]
    assert row["seen_following"] == row["frames"] > 20
    if environment == "oodil/Hopper-v0":
        assert row["seen_still"] < row["frames"] / 2, "a camera that stays would lose it"


def test_a_camera_follows_what_can_walk_away() -> None:
    """Ant has a free joint, HalfCheetah slides; Reacher and Pusher stand on the ground."""
    for name, body in (("Ant-v5", "torso"), ("HalfCheetah-v5", "torso"), ("Reacher-v5", ""), ("Pusher-v5", "")):
        model = gymnasium.make(name).unwrapped.model  # type: ignore[attr-defined]
        followed = walker_of(model)
        assert (model.body(followed).name if followed > 0 else "") == body, name


def test_what_cannot_be_rendered_says_what_is_missing(tmp_path: Path) -> None:
    done = in_a_process("disabled", "-c", PROGRAM, str(tmp_path / "film.mp4"))
    assert done.returncode != 0
    assert "cannot render here" in done.stderr and "libosmesa6" in done.stderr
