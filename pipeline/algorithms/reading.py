"""How much of a demonstration an imitator reproduces, read by discriminators that were not trained on it.

The discriminator of a training cannot say it: it has seen every demonstration of the cluster, and lags behind the
policy. So fresh ones are trained against the finished imitator, each on half of the demonstrations and half of the
imitator's episodes, and read the other halves.

Letters: N demonstrations, E episodes, R repetitions, B batch.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from oodil.pipeline.algorithms.discriminator import Discriminator
from oodil.pipeline.config import DiscriminatorConfig, ReadingConfig
from oodil.pipeline.data import Demonstrations, offsets_of
from oodil.pipeline.seeding import derive_key, numpy_rng, torch_seed

Array = NDArray[np.float64]


def divergences(
    demonstrations: Demonstrations,
    episodes: Demonstrations,
    discriminator: DiscriminatorConfig,
    reading: ReadingConfig,
    seed: int,
) -> Array:
    """Return (R, N): how far each demonstration is from an imitator's episodes, in nats per transition.

    It is the mean logit over the demonstration less that over episodes, both held out; for a discriminator that has
    learned the ratio of densities that is the symmetric Kullback-Leibler divergence, and 0 where they are the same. Each
    repetition draws other halves. A single demonstration has no halves: the discriminator that reads it has seen it.
    """
    weights = np.ones(len(demonstrations))

    def fresh(*name: int | str) -> Discriminator:
        return Discriminator(demonstrations, weights, discriminator, torch_seed(derive_key(seed, "reading", *name)))

    view = fresh("view")
    shown, played = _Transitions(demonstrations, view), _Transitions(episodes, view)
    found = np.empty((reading.repetitions, len(demonstrations)))
    for r in range(reading.repetitions):
        rng = numpy_rng(derive_key(seed, "reading", r))
        half_shown, half_played = shown.half(rng), played.half(rng)
        for side in (True, False):
            net = fresh(r, int(side))
            ours, theirs = shown.rows(half_shown == side), played.rows(half_played == side)
            for _ in range(reading.steps):
                net.update(shown.draw(ours, reading.batch_size, rng), played.draw(theirs, reading.batch_size, rng))
            reference = played.mean_logits(net)[half_played != side].mean()
            read = half_shown != side if len(demonstrations) > 1 else np.array([True])
            found[r, read] = shown.mean_logits(net)[read] - reference
    return found


class _Transitions:
    """What a discriminator sees of the transitions of several demonstrations or episodes."""

    def __init__(self, demonstrations: Demonstrations, view: Discriminator) -> None:
        starts = demonstrations.transition_starts()
        states = demonstrations.observations
        self._inputs = view.inputs(states[starts], states[starts + 1])
        self._counts = demonstrations.lengths - 1

    def half(self, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Return (N,) whether each belongs to a random half; of one alone, both halves are the whole."""
        count = len(self._counts)
        return rng.permutation(count) < count // 2

    def rows(self, chosen: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the transitions of the (N,) chosen ones; of all where none is chosen."""
        return np.flatnonzero(np.repeat(chosen if chosen.any() else ~chosen, self._counts))

    def draw(self, rows: NDArray[np.intp], count: int, rng: np.random.Generator) -> Tensor:
        """Return (count, 2S) inputs, drawn with replacement."""
        return self._inputs[torch.from_numpy(rng.choice(rows, count))]

    @torch.no_grad()
    def mean_logits(self, net: Discriminator) -> Array:
        """Return (N,) mean logits over the transitions of each."""
        logits = net(self._inputs).double().numpy()
        return np.asarray(np.add.reduceat(logits, offsets_of(self._counts)[:-1]) / self._counts)
