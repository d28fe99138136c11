"""What the policies do: some frames of an episode of ours, and of one that learns from everything alike beside it."""

import base64
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.errors import OodilError
from oodil.pipeline.filming import open_stage, strip
from oodil.pipeline.report import formats
from oodil.pipeline.report.summary import Findings
from oodil.pipeline.seeding import derive_key

NUM_FRAMES = 5
LEAST_HEIGHT, QUALITY = 220, 78
"""Of a frame on the page, in pixels unless it was drawn smaller, and as a JPEG: some ten kilobytes each."""


@dataclass(frozen=True)
class FilmStrip:
    """An episode of one policy."""

    title: str
    outcome: str
    """Its length and its return."""
    frames: tuple[tuple[int, str], ...]
    """Each with the number of steps before it, as an address that holds the picture itself."""


@dataclass(frozen=True)
class FilmSection:
    """Episodes that begin alike."""

    strips: tuple[FilmStrip, ...]
    missing: str
    """Why there are none; empty if there are."""


def read_films(found: Findings) -> FilmSection | None:
    """Film the first policy and the first without a weighting; None while neither is trained."""
    policies = found.results.policies
    chosen = [policies[0], *[each for each in policies[1:] if not each.weighting][:1]]
    titles = {each.name: each.title for each in chosen if each.name in found.finals}
    if not titles:
        return None
    try:
        return FilmSection(tuple(_film(found, titles)), "")
    except OodilError as error:
        return FilmSection((), str(error))


def _film(found: Findings, titles: dict[str, str]) -> Iterator[FilmStrip]:
    config = found.results.config
    with closing(open_stage(config.environment.id, config.environment.dynamics)) as simulators:
        for name, title in titles.items():
            policy = found.results.policy(name).gaussian
            seen = strip(policy, simulators, derive_key(config.seed, "film"), NUM_FRAMES)
            outcome = f"{formats.plural(seen.num_steps, 'step')}, return {formats.returned(seen.env_return)}"
            yield FilmStrip(title, outcome, tuple((step, _address(frame)) for step, frame in seen.frames))


def _address(frame: NDArray[np.uint8]) -> str:
    """Return a frame, each pixel the mean of a square of its pixels, as an address."""
    side = max(1, len(frame) // LEAST_HEIGHT)
    height, width = (size // side for size in frame.shape[:2])
    squares = frame[: height * side, : width * side].reshape(height, side, width, side, 3)
    smaller = squares.mean(axis=(1, 3)).round().astype(np.uint8)
    encoded = imageio.imwrite("<bytes>", smaller, extension=".jpg", quality=QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(encoded).decode()}"
