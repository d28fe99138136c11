"""What the policies do: some frames of an episode of ours, and of one that learns from everything alike beside it."""

import base64
import io
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from oodil.pipeline.errors import OodilError
from oodil.pipeline.filming import open_stage, strip
from oodil.pipeline.report import formats
from oodil.pipeline.report.summary import Findings
from oodil.pipeline.seeding import derive_key

NUM_FRAMES = 5
HEIGHT, QUALITY = 220, 78
"""Of a frame on the page, in pixels, and as a JPEG: some five kilobytes each."""


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
    image = Image.fromarray(frame)
    image.thumbnail((2 * HEIGHT, HEIGHT))
    held = io.BytesIO()
    image.save(held, "JPEG", quality=QUALITY, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(held.getvalue()).decode()}"
