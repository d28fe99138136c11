"""Streams are named: equal names, equal streams; different names, different streams."""

import numpy as np

from oodil.pipeline.seeding import derive_key, numpy_rng, torch_seed

NAMES = [
    (0, "rollout", 0, 0),
    (0, "rollout", 0, 1),
    (0, "rollout", 1, 0),
    (0, "learner", 0, 0),
    (1, "rollout", 0, 0),
    (0, "learner", "initial", 0),
]


def test_equal_keys_give_equal_streams():
    for root, *path in NAMES:
        one, two = (numpy_rng(derive_key(root, *path)).random(4) for _ in range(2))
        np.testing.assert_array_equal(one, two)
        assert torch_seed(derive_key(root, *path)) == torch_seed(derive_key(root, *path))


def test_different_keys_give_different_streams():
    keys = [derive_key(root, *path) for root, *path in NAMES]
    assert len(set(keys)) == len(keys)
    draws = {numpy_rng(key).integers(2**62) for key in keys}
    assert len(draws) == len(keys)
    assert len({torch_seed(key) for key in keys}) == len(keys)


def test_a_trailing_zero_is_part_of_the_name():
    """NumPy pads short seeds with zeros, so (5, "x") and (5, "x", 0) would be one stream if the key were entropy."""
    one, two = numpy_rng(derive_key(5, "x")), numpy_rng(derive_key(5, "x", 0))
    assert one.random() != two.random()


def test_torch_seeds_fit_into_63_bits():
    assert all(0 <= torch_seed((i,)) < 2**63 for i in range(200))


def test_names_give_the_same_key_in_every_process():
    """Python's own hash of a string differs from process to process; this one must not."""
    assert derive_key(7, "rollout", 2, 5) == (7, 1956693391, 2, 5)
