"""Films of a policy: one deterministic episode, played as `oodil.pipeline.evaluation.run_episodes` does."""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.collecting import begin
from oodil.pipeline.environments import Simulators, make_batch
from oodil.pipeline.environments.batch import VisibleSimulators
from oodil.pipeline.environments.pictures import choose_backend
from oodil.pipeline.errors import StorageError, UnusableEnvironmentError
from oodil.pipeline.policy import Controller
from oodil.pipeline.seeding import Key, numpy_rng

FRAMES_PER_SECOND = 30
"""Of a film, about; the environments run at 10 to 240 steps per second of simulated time."""


@dataclass(frozen=True)
class Strip:
    """Some frames of an episode."""

    frames: tuple[tuple[int, NDArray[np.uint8]], ...]
    """Each with the number of steps before it."""
    num_steps: int
    env_return: float


def open_stage(env_id: str, dynamics: Mapping[str, Any]) -> VisibleSimulators:
    """Return one simulator that can be rendered. Raises UnusableEnvironmentError if there can be none."""
    choose_backend()
    arguments: dict[str, Any] = {**dynamics, "render_mode": "rgb_array"}
    simulators: Any = make_batch(env_id, arguments, 1)
    made: VisibleSimulators = simulators
    return made


def play(simulators: Simulators, controller: Controller, key: Key) -> Iterator[int]:
    """Play one fresh episode in the first simulator and give the number of steps before each of its states."""
    begin(simulators, 0, numpy_rng(key), None)
    yield (step := 0)
    ended = False
    while not ended:
        outcome = simulators.step(controller.mean(simulators.observations()))
        ended = bool(outcome.terminated[0] or outcome.truncated[0])
        yield (step := step + 1)


def film(controller: Controller, env_id: str, dynamics: Mapping[str, Any], key: Key, path: Path) -> float:
    """Film one deterministic episode as MP4 and return its true return.

    It is the first of those that an evaluation with the same key runs. Raises UnusableEnvironmentError when nothing
    can be rendered here, with what is missing, and StorageError for a path that cannot be written.
    """
    check_writable(path)
    with closing(open_stage(env_id, dynamics)) as simulators:
        every = max(1, round(simulators.steps_per_second / FRAMES_PER_SECOND))
        with _new_film(path, simulators.steps_per_second / every) as add:
            for step in play(simulators, controller, key):
                if step % every == 0:
                    add(picture(simulators))
            return float(simulators.episode_returns()[0])


def strip(controller: Controller, simulators: VisibleSimulators, key: Key, count: int) -> Strip:
    """Return ``count`` frames of one deterministic episode, from its first state to its last.

    It is played twice, so that no more is drawn than is shown. Raises UnusableEnvironmentError as `film` does.
    """
    num_steps = 0
    for num_steps in play(simulators, controller, key):
        if not num_steps:
            picture(simulators)  # Whether it can be drawn at all, before anything is played.
    env_return = float(simulators.episode_returns()[0])
    wanted = set(np.linspace(0, num_steps, count).round().astype(int).tolist())
    frames = [(step, picture(simulators)) for step in play(simulators, controller, key) if step in wanted]
    return Strip(tuple(frames), num_steps, env_return)


def picture(simulators: VisibleSimulators) -> NDArray[np.uint8]:
    """Return a picture of the first simulator. Raises UnusableEnvironmentError, with what is missing."""
    try:
        return simulators.render(0)
    except UnusableEnvironmentError:
        raise
    except Exception as error:  # Whatever a foreign environment or a machine's OpenGL raises.
        raise UnusableEnvironmentError(
            f"cannot render here ({error}); a machine without a display needs EGL or OSMesa "
            "(Debian: apt-get install libegl1 or libosmesa6, then MUJOCO_GL=egl or MUJOCO_GL=osmesa)"
        ) from error


def check_writable(path: Path) -> None:
    """Raise StorageError, before any work, for a path that no film can be written to."""
    if path.is_dir():
        raise StorageError(f"{path}: is a folder; the film is to be written there")
    with _refusing(path), tempfile.NamedTemporaryFile(dir=path.parent):
        pass


@contextmanager
def _new_film(path: Path, frames_per_second: float) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Give a function that adds a frame; the film is at ``path`` once it is whole. Raises StorageError."""
    import imageio
    from imageio_ffmpeg import count_frames_and_secs

    temporary = path.with_name(f".{path.stem}.new{path.suffix}")
    count = 0

    def add(frame: NDArray[np.uint8]) -> None:
        nonlocal count
        with _refusing(path):
            writer.append_data(frame)
        count += 1

    try:
        with _refusing(path):
            writer: Any = imageio.get_writer(
                temporary, fps=frames_per_second, macro_block_size=2, ffmpeg_log_level="fatal"
            )
        with writer:
            yield add
        with _refusing(path):
            # ffmpeg does not say that it could not write the last frames.
            if count_frames_and_secs(temporary)[0] != count:
                raise OSError("the film could not be written as a whole; the disk may be full")
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError) as error:  # The second: ffmpeg's frames that cannot be counted.
        raise StorageError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
