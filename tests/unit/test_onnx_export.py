"""An exported model and the policy it was made from act alike, from raw observations to actions within bounds."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from oodil.pipeline.algorithms.networks import PolicyNetwork
from oodil.pipeline.policy import LARGEST_INPUT
from oodil.pipeline.results import Policy

pytest.importorskip("onnx", reason="pip install 'oodil[onnx]'")
onnxruntime = pytest.importorskip("onnxruntime")

STATES = 1000


@pytest.fixture
def policy(network: Callable[..., PolicyNetwork]) -> Policy:
    """A policy for observations of (2, 3) and actions of (4,): small, without bounds, in newtons, with one bound."""
    gaussian = network(observation_dim=6, action_dim=4, hidden=(16, 12)).export()
    weights = (*gaussian.weights[:-1], gaussian.weights[-1] * 5)  # so that some actions reach their bounds
    gaussian = replace(gaussian, weights=weights, input_limit=LARGEST_INPUT)
    low, high = np.float32([-0.2, -np.inf, -2000, -np.inf]), np.float32([0.1, np.inf, 3000, 0.05])
    return Policy(gaussian, "Some-v0", (2, 3), low, high, env_steps=7)


def session(policy: Policy, path: Path) -> "onnxruntime.InferenceSession":
    from oodil.pipeline.onnx_export import write_onnx

    write_onnx(policy, "imitation", path)
    return onnxruntime.InferenceSession(str(path))


def observations(shape: tuple[int, ...]) -> np.ndarray:
    """Return states, some of which standardize to far beyond the limit of the inputs."""
    rng = np.random.default_rng(0)
    return (rng.standard_normal((STATES, *shape)) * rng.choice([0.1, 1, 100], (STATES, *shape))).astype(np.float32)


def test_a_thousand_states_give_the_actions_of_the_policy(policy: Policy, tmp_path: Path) -> None:
    seen = observations(policy.observation_shape)
    expected = policy.act(seen)
    (action,) = session(policy, tmp_path / "policy.onnx").run(None, {"observation": seen})
    assert (action.shape, action.dtype) == ((STATES, 4), np.float32)
    in_units = np.float32([0.15, 1, 2500, 1])  # half of what lies between two bounds
    np.testing.assert_allclose(action / in_units, expected / in_units, rtol=0, atol=5e-6)
    standardized = (seen.reshape(STATES, -1) - policy.gaussian.input_mean) * policy.gaussian.input_scale
    assert (np.abs(standardized) > LARGEST_INPUT).any() and (np.abs(standardized) < LARGEST_INPUT).all(axis=1).any()
    assert all((expected[:, a] == bound[a]).any() for a, bound in [(0, policy.action_high), (2, policy.action_low)])


def test_one_observation_alone_and_a_policy_without_limits(policy: Policy, tmp_path: Path) -> None:
    free = np.full((2, 2), np.inf, np.float32)
    gaussian = replace(policy.gaussian, input_limit=float("inf"))
    unlimited = Policy(gaussian, "Some-v0", (6,), -free, free)
    seen = observations((6,))[:1]
    (action,) = session(unlimited, tmp_path / "policy.onnx").run(None, {"observation": seen})
    assert action.shape == (1, 2, 2)
    np.testing.assert_allclose(action[0], unlimited.act(seen[0]), rtol=0, atol=2e-6)


def test_whole_actions_are_rounded(policy: Policy, tmp_path: Path) -> None:
    bounds = np.full(4, 9, np.float32)
    whole = replace(policy, action_low=-bounds, action_high=bounds, acts_in_integers=True)
    seen = observations(policy.observation_shape)
    (action,) = session(whole, tmp_path / "policy.onnx").run(None, {"observation": seen})
    assert set(np.unique(action)) == set(range(-9, 10))
    assert (action == whole.act(seen)).mean() > 0.999, "the networks' outputs differ in their last bits"


def test_the_file_says_where_it_comes_from(policy: Policy, tmp_path: Path) -> None:
    loaded = session(policy, tmp_path / "policy.onnx")
    assert loaded.get_modelmeta().custom_metadata_map == {"environment": "Some-v0", "env_steps": "7"}
    assert loaded.get_modelmeta().graph_name == "imitation"
    assert [(each.name, each.shape) for each in (*loaded.get_inputs(), *loaded.get_outputs())] == [
        ("observation", ["batch", 2, 3]),
        ("action", ["batch", 4]),
    ]
