"""How much of a demonstration an imitator reproduces, read by discriminators that were not trained on it.

The discriminator of a training cannot say it: it has seen every demonstration of the cluster, and lags behind the
policy. So fresh ones are trained against the finished imitator, each on half of the demonstrations and half of the
imitator's episodes, and read the other halves. The paper reads that of the training (`LastDiscriminator`).

Letters: N demonstrations, E episodes, R repetitions, D discriminators (two in each repetition), B batch.
"""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from oodil.pipeline.algorithms.discriminator import Discriminator, mean_logit_per_demonstration, mean_logits
from oodil.pipeline.artifacts import below, nested
from oodil.pipeline.config import DiscriminatorConfig, ReadingConfig
from oodil.pipeline.data import Demonstrations
from oodil.pipeline.seeding import derive_key, numpy_rng, torch_seed

Array = NDArray[np.float64]


class Readers:
    """Discriminators between demonstrations and an imitator's episodes, each trained on half of both."""

    def __init__(
        self, demonstrations: Demonstrations, discriminator: DiscriminatorConfig, config: ReadingConfig, seed: int
    ) -> None:
        """Draw the untrained discriminators of demonstrations that all count the same."""
        self._config = config
        self._demonstrations = demonstrations
        self._seed = seed
        weights = np.ones(len(demonstrations))
        seeds = [torch_seed(derive_key(seed, "reading", "initial", d)) for d in range(config.num_readers)]
        update = {"learning_rate": config.learning_rate, "gradient_penalty": config.gradient_penalty}
        judge = discriminator.model_copy(update=update)
        self._nets = [Discriminator(demonstrations, weights, judge, each) for each in seeds]
        self.view = self._nets[0]
        """Any of them: all see transitions in the same way."""
        self._references = np.zeros(len(self._nets))
        """(D,) mean logit of each over the episodes that it has not seen."""

    def train(
        self,
        episodes: Demonstrations,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> Array:
        """Train all of them, and return the (R, N) divergences of the demonstrations, none read by one that saw it.

        A single demonstration has no halves, and is read by those that have seen it.
        """
        shown, played = self._transitions(self._demonstrations), self._transitions(episodes)
        found = np.empty((len(self._nets) // 2, len(self._demonstrations)))
        for d, net in enumerate(self._nets):
            r, side = divmod(d, 2)
            halves = numpy_rng(derive_key(self._seed, "reading", "halves", r))
            half_shown, half_played = (each.half(halves) == bool(side) for each in (shown, played))
            rng = numpy_rng(derive_key(self._seed, "reading", "batches", d))
            ours, theirs = shown.rows(half_shown), played.rows(half_played)
            size = self._config.batch_size
            for _ in range(self._config.steps):
                net.update(shown.draw(ours, size, rng), played.draw(theirs, size, rng))
            self._references[d] = played.mean_logits(net)[~half_played].mean()
            unseen = ~half_shown if len(half_shown) > 1 else np.array([True])
            found[r, unseen] = shown.mean_logits(net)[unseen] - self._references[d]
            progress(d + 1, len(self._nets))
        return found

    def divergences(self, demonstrations: Demonstrations) -> Array:
        """Return (D, N) divergences of demonstrations that none of them was trained on."""
        transitions = self._transitions(demonstrations)
        logits = np.stack([transitions.mean_logits(net) for net in self._nets])
        return np.asarray(logits - self._references[:, None])

    def arrays(self) -> dict[str, NDArray]:
        """Return everything that `divergences` needs; `load` is the inverse."""
        arrays: dict[str, NDArray] = {"references": self._references}
        for d, net in enumerate(self._nets):
            arrays |= nested(str(d), {name: value.numpy() for name, value in net.state_dict().items()})
        return arrays

    def load(self, arrays: dict[str, NDArray]) -> None:
        """Take over trained discriminators."""
        self._references = arrays["references"]
        for d, net in enumerate(self._nets):
            net.load_state_dict({name: torch.from_numpy(value) for name, value in below(str(d), arrays).items()})

    def _transitions(self, demonstrations: Demonstrations) -> "_Transitions":
        return _Transitions(demonstrations, self.view)


class LastDiscriminator:
    """The discriminator that an imitator was trained against, as it stood last: Eqn (6)."""

    def __init__(self, demonstrations: Demonstrations, config: DiscriminatorConfig, seed: int) -> None:
        self.view = Discriminator(demonstrations, np.ones(len(demonstrations)), config, seed)

    def load(self, arrays: dict[str, NDArray]) -> None:
        """Take over its parameters."""
        self.view.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})

    def divergences(self, demonstrations: Demonstrations) -> Array:
        """Return (1, N) divergences: twice the mean logits, as if those over the imitator's episodes were opposite."""
        return 2 * mean_logit_per_demonstration(self.view, demonstrations)[None]


class _Transitions:
    """What a discriminator sees of the transitions of several demonstrations or episodes."""

    def __init__(self, demonstrations: Demonstrations, view: Discriminator) -> None:
        starts = demonstrations.transition_starts()
        states = demonstrations.observations
        self._inputs = view.inputs(states[starts], states[starts + 1])
        self._counts = demonstrations.lengths - 1

    def half(self, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Return (N,) whether each belongs to a random half."""
        count = len(self._counts)
        return rng.permutation(count) < count // 2

    def rows(self, chosen: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the transitions of the (N,) chosen ones; of all if none is chosen, which is so with one alone."""
        return np.flatnonzero(np.repeat(chosen if chosen.any() else ~chosen, self._counts))

    def draw(self, rows: NDArray[np.intp], count: int, rng: np.random.Generator) -> Tensor:
        """Return (count, 2S) inputs, drawn with replacement."""
        return self._inputs[torch.from_numpy(rng.choice(rows, count))]

    def mean_logits(self, net: Discriminator) -> Array:
        """Return (N,) mean logits over the transitions of each."""
        return mean_logits(net, self._inputs, self._counts)
