"""Readings: nobody reads what it was trained on, the same reads one, and the frozen readers say it again."""

import numpy as np
import pytest

from oodil.pipeline.algorithms.discriminator import Discriminator
from oodil.pipeline.algorithms.reading import LastDiscriminator, Readers
from oodil.pipeline.algorithms.weights import transferability_of_divergences
from oodil.pipeline.config import DiscriminatorConfig, ReadingConfig
from oodil.pipeline.data import Demonstrations, Episode

QUICK = ReadingConfig(steps=150, batch_size=128, repetitions=2)


def walks(count, seed, drift=0.0, length=60):
    """Return random walks of three dimensions."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(count, length, 3)) + drift
    return Demonstrations.of([Episode(each.cumsum(axis=0) / 10) for each in steps], "walks")


def readers(demonstrations, config=QUICK, seed=0):
    return Readers(demonstrations, DiscriminatorConfig(), config, seed)


def test_no_demonstration_is_read_by_a_discriminator_that_was_trained_on_it(monkeypatch):
    """Every demonstration stands on a spot of its own, so what a discriminator is trained on says whose it is."""
    demonstrations = Demonstrations.of([Episode(np.full((5, 1), float(n))) for n in range(9)], "spots")
    spots = np.unique(readers(demonstrations)._transitions(demonstrations)._inputs.numpy()[:, 0])
    seen: dict[int, set[int]] = {}

    def spy(net, shown, played):
        seen.setdefault(id(net), set()).update(np.searchsorted(spots, shown.numpy()[:, 0]).tolist())

    monkeypatch.setattr(Discriminator, "update", spy)
    several = readers(demonstrations)
    found = several.train(walks(6, 1).__class__.of([Episode(np.zeros((5, 1)))] * 6, "still"))
    again = several.divergences(demonstrations)
    for d, trained_on in enumerate(seen.values()):
        assert 4 <= len(trained_on) <= 5
        unseen = sorted(set(range(9)) - trained_on)
        np.testing.assert_array_equal(found[d // 2, unseen], again[d, unseen])


def test_the_same_reads_one_and_what_differs_in_its_changes_alone_reads_less():
    shown = walks(20, 0)
    same = transferability_of_divergences(readers(shown).train(walks(20, 1)))
    other = transferability_of_divergences(readers(shown).train(walks(20, 1, drift=2.0)))
    assert same.mean() > 0.85
    assert other.max() < 0.4


def test_frozen_readers_say_it_again_and_so_do_those_of_the_same_seed(assert_same_bits):
    shown, played = walks(6, 0), walks(8, 1, drift=0.5)
    one, two, loaded = (readers(shown) for _ in range(3))
    assert_same_bits(one.train(played), two.train(played))
    loaded.load(one.arrays())
    fresh = walks(3, 5)
    assert_same_bits(one.divergences(fresh), loaded.divergences(fresh))


def test_one_demonstration_is_read_by_those_that_have_seen_it():
    alone = walks(1, 0)
    found = readers(alone).train(walks(8, 1))
    assert found.shape == (2, 1)
    assert np.isfinite(found).all()


@pytest.mark.parametrize("repetitions", [1, 3])
def test_each_repetition_draws_other_halves(repetitions):
    config = QUICK.model_copy(update={"repetitions": repetitions, "steps": 20})
    found = readers(walks(6, 0), config).train(walks(8, 1))
    assert found.shape == (repetitions, 6)
    assert len(np.unique(found[:, 0])) == repetitions


def test_the_last_discriminator_reads_eqn_6(demonstrations):
    """The score is twice the probability that a demonstration is the imitator's, by its mean logit, and at most 1."""
    made = demonstrations(4, 9, 3)
    config = DiscriminatorConfig(view="raw", hidden=(8,))
    trained = Discriminator(made, np.ones(3), config, seed=3)
    trained.net.layers[-1].weight.data.mul_(30)
    reader = LastDiscriminator(made, config, seed=0)
    reader.load({name: value.numpy() for name, value in trained.state_dict().items()})
    logits = []
    for n in range(3):
        states = made[n]
        logits.append(float(trained(trained.inputs(states[:-1], states[1:])).detach().mean()))
    expected = [min(1, 2 / (1 + np.exp(logit))) for logit in logits]
    np.testing.assert_allclose(transferability_of_divergences(reader.divergences(made)), [expected], rtol=1e-5)
    assert len(set(expected)) > 1
