"""What the tests share: one thread of computation, and small pieces of experience."""

import os

# Before NumPy and torch are imported: the results that are compared to the bit are those of one thread.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402

import hypothesis  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

import oodil  # noqa: E402
from oodil.pipeline.algorithms.networks import PolicyNetwork  # noqa: E402
from oodil.pipeline.data import Demonstrations, Rollout  # noqa: E402
from oodil.pipeline.policy import GaussianPolicy  # noqa: E402
from tests.runs import MICRO  # noqa: E402

torch.set_num_threads(1)
# A busy machine is no defect, and the gate must give the same answer twice.
hypothesis.settings.register_profile("oodil", deadline=None, derandomize=True)
hypothesis.settings.load_profile("oodil")

Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of whole runs and real processes are slow; among the others, the slow ones say so themselves."""
    for item in items:
        if {"integration", "fault"} & set(item.path.relative_to(Path(__file__).parent).parts):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The SHA-256 of each stage of the micro run, naive GAIL included, that nothing disturbed, made in this process."""
    path = tmp_path_factory.mktemp("undisturbed") / "run"
    described = oodil.run(MICRO, ["baselines=[naive_gail]"], workers=0, run_dir=path).describe()
    return {name: stage["sha256"] for name, stage in described["stages"].items()}


@pytest.fixture
def network() -> Callable[..., PolicyNetwork]:
    """Return a function that builds a policy network whose head is not small, so that actions depend on states."""

    def build(
        observation_dim: int = 4, action_dim: int = 2, hidden: tuple[int, ...] = (8, 8), seed: int = 0
    ) -> PolicyNetwork:
        rng = torch.Generator().manual_seed(seed)
        policy = PolicyNetwork(observation_dim, action_dim, hidden, rng)
        with torch.no_grad():
            policy.net.layers[-1].weight.mul_(10)
            policy.net.layers[-1].bias.copy_(0.1 * torch.randn(action_dim, generator=rng))
            policy.log_std.copy_(0.3 * torch.randn(action_dim, generator=rng))
            policy.input_mean.copy_(0.2 * torch.randn(observation_dim, generator=rng))
            policy.input_scale.copy_(0.5 + torch.rand(observation_dim, generator=rng))
        return policy

    return build


@pytest.fixture
def plain_mlp() -> Callable[..., torch.Tensor]:
    """Return an MLP as a function of its parameters and input, all in torch, which differentiates it in every way."""

    def output(parameters: list[torch.Tensor], x: torch.Tensor) -> torch.Tensor:
        *hidden, head = zip(parameters[::2], parameters[1::2], strict=True)
        for weight, bias in hidden:
            x = torch.tanh(torch.nn.functional.linear(x, weight, bias))
        return torch.nn.functional.linear(x, *head)

    return output


@pytest.fixture
def batch() -> Callable[..., Batch]:
    """Return a function that draws (observations, actions, log-probabilities, advantages) from a policy."""

    def draw(policy: PolicyNetwork, size: int, seed: int = 1) -> Batch:
        rng = torch.Generator().manual_seed(seed)
        dtype = policy.log_std.dtype
        observations = torch.randn(size, len(policy.input_mean), generator=rng, dtype=dtype)
        noise = torch.randn(size, len(policy.log_std), generator=rng, dtype=dtype)
        advantages = torch.randn(size, generator=rng, dtype=dtype)
        with torch.no_grad():
            mean = policy(observations)
            actions = mean + noise * policy.log_std.exp()
            return observations, actions, policy.log_prob(mean, actions), advantages

    return draw


@pytest.fixture
def demonstrations() -> Callable[..., Demonstrations]:
    """Return a function that makes demonstrations of given lengths; state t of number n starts with (n, t)."""

    def make(*lengths: int, observation_dim: int = 3) -> Demonstrations:
        rng = np.random.default_rng(0)
        states = rng.standard_normal((sum(lengths), observation_dim)).astype(np.float32)
        states[:, 0] = np.repeat(np.arange(len(lengths)), lengths)
        states[:, 1] = np.concatenate([np.arange(length) for length in lengths])
        return Demonstrations(
            observations=states,
            offsets=np.cumsum([0, *lengths]).astype(np.int64),
            sources=np.zeros(len(lengths), np.int32),
            source_labels=("only",),
            returns=np.full(len(lengths), np.nan),
            terminated=np.zeros(len(lengths), np.bool_),
        )

    return make


@pytest.fixture
def rollout() -> Callable[..., Rollout]:
    """Return a function that makes a random rollout of T steps of G simulators."""

    def make(seed: int, num_steps: int = 6, num_simulators: int = 3, observation_dim: int = 3) -> Rollout:
        rng = np.random.default_rng(seed)
        shape = (num_steps, num_simulators)

        def normal(*size: int) -> NDArray[np.float32]:
            return rng.standard_normal(size, dtype=np.float32)

        return Rollout(
            policy_version=0,
            observations=normal(*shape, observation_dim),
            next_observations=normal(*shape, observation_dim),
            actions=normal(*shape, 2),
            log_probs=normal(*shape),
            terminated=rng.random(shape) < 0.2,
            truncated=rng.random(shape) < 0.2,
            env_rewards=rng.standard_normal(shape),
            episode_returns=np.zeros(0),
            episode_lengths=np.zeros(0, np.int64),
        )

    return make


@pytest.fixture
def assert_same_bits() -> Callable[[object, object], None]:
    """Return a function that compares two (nested) dataclasses, dictionaries or arrays byte by byte."""

    def compare(one: object, other: object, at: str = "result") -> None:
        assert type(one) is type(other), at
        if isinstance(one, torch.Tensor):
            one, other = one.detach().numpy(), other.detach().numpy()  # type: ignore[attr-defined]
        if isinstance(one, np.ndarray):
            assert isinstance(other, np.ndarray)
            assert (one.dtype, one.shape) == (other.dtype, other.shape), at
            assert one.tobytes() == other.tobytes(), f"{at} differs by up to {np.abs(one - other).max()}"
        elif isinstance(one, dict):
            assert isinstance(other, dict)
            assert one.keys() == other.keys(), at
            for key in one:
                compare(one[key], other[key], f"{at}[{key}]")
        elif isinstance(one, list | tuple):
            assert isinstance(other, list | tuple)
            assert len(one) == len(other), at
            for i, (a, b) in enumerate(zip(one, other, strict=True)):
                compare(a, b, f"{at}[{i}]")
        elif hasattr(one, "__dataclass_fields__"):
            for name in one.__dataclass_fields__:
                compare(getattr(one, name), getattr(other, name), f"{at}.{name}")
        else:
            assert one == other, at

    return compare


@pytest.fixture
def idle_policy() -> Callable[[int, int], GaussianPolicy]:
    """Return a function that makes a policy whose actions do not depend on any noise."""

    def make(observation_dim: int, action_dim: int) -> GaussianPolicy:
        rng = np.random.default_rng(3)
        return GaussianPolicy(
            weights=(rng.standard_normal((observation_dim, action_dim), dtype=np.float32),),
            biases=(rng.standard_normal(action_dim, dtype=np.float32),),
            log_std=np.full(action_dim, -np.inf, np.float32),
            input_mean=np.zeros(observation_dim, np.float32),
            input_scale=np.full(observation_dim, 0.1, np.float32),
        )

    return make
