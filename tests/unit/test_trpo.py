"""TRPO against stable-baselines3's, against second derivatives by autograd, and at its limits."""

import gymnasium
import numpy as np
import pytest
import torch
from torch.distributions import Normal, kl_divergence
from torch.func import hessian

import oodil.pipeline.algorithms.trpo as trpo_module
import oodil.pipeline.environments  # noqa: F401  (registers the ids)
from oodil.pipeline.algorithms.trpo import Trpo, conjugate_gradient
from oodil.pipeline.config import TrpoConfig


def improve(policy, config, observations, actions, log_probs, advantages, step_scale=1.0):
    """One update, with states for the Fisher matrix drawn by seed 0."""
    return Trpo(policy, config).update(
        observations, actions, log_probs, advantages, torch.Generator().manual_seed(0), step_scale
    )


def parameters_of(policy):
    return torch.cat([p.detach().reshape(-1) for p in policy.parameters()])


def mean_kl(policy, before, observations):
    """KL(before || policy) by torch.distributions, averaged over the batch."""
    with torch.no_grad():
        old = Normal(before(observations), before.log_std.exp())
        new = Normal(policy(observations), policy.log_std.exp())
        return float(kl_divergence(old, new).sum(-1).mean())


def test_conjugate_gradient_solves_a_linear_system():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((12, 12))
    matrix = root @ root.T + np.eye(12)
    b = rng.standard_normal(12)
    product = torch.from_numpy(matrix)
    x = conjugate_gradient(lambda v: product @ v, torch.from_numpy(b), iterations=50, tolerance=1e-26)
    np.testing.assert_allclose(x.numpy(), np.linalg.solve(matrix, b), rtol=1e-9)


def test_conjugate_gradient_stops_at_the_tolerance_and_at_the_limit():
    calls = []

    def product(v):
        calls.append(v)
        return torch.tensor([1.0, 2.0, 3.0]) * v

    b = torch.ones(3)
    # Three distinct eigenvalues need three iterations; the squared residual of zero is |b|^2 = 3.
    assert torch.equal(conjugate_gradient(product, b, 10, tolerance=3.0), torch.zeros(3))
    assert not calls
    conjugate_gradient(product, b, iterations=2, tolerance=0.0)
    assert len(calls) == 2


@pytest.mark.parametrize("every", [1, 4])
def test_fisher_product_is_the_second_derivative_of_the_divergence(network, batch, plain_mlp, monkeypatch, every):
    """The damped Fisher matrix, column by column, equals the Hessian of KL(old || new) over one state in n."""
    policy = network(observation_dim=3, action_dim=2, hidden=(4, 3)).double()
    observations, actions, log_probs, advantages = batch(policy, 20)
    columns = []

    def spy(product, b, iterations, tolerance):
        columns.extend(product(unit) for unit in torch.eye(len(b), dtype=b.dtype))
        return conjugate_gradient(product, b, iterations, tolerance)

    monkeypatch.setattr(trpo_module, "conjugate_gradient", spy)
    shapes = [p.shape for p in policy.parameters()]
    drawn = torch.randperm(20, generator=torch.Generator().manual_seed(0))[: 20 // every]
    seen = observations if every == 1 else observations[drawn]
    old_mean, old_std = policy(seen).detach(), policy.log_std.detach().exp()

    def divergence(flat):
        parts = flat.split([shape.numel() for shape in shapes])
        log_std, *layers = (part.view(shape) for part, shape in zip(parts, shapes, strict=True))
        new = Normal(plain_mlp(layers, policy.normalize(seen)), log_std.exp())
        return kl_divergence(Normal(old_mean, old_std), new).sum(-1).mean()

    expected = hessian(divergence)(parameters_of(policy).clone())
    improve(policy, TrpoConfig(damping=0.07, fisher_every=every), observations, actions, log_probs, advantages)
    fisher = torch.stack(columns, dim=1)
    torch.testing.assert_close(
        fisher, expected + 0.07 * torch.eye(len(expected), dtype=expected.dtype), rtol=1e-9, atol=1e-12
    )


def test_step_equals_stable_baselines3(network, batch):
    """Same weights, same batch, same advantages: the same update as sb3-contrib's TRPO, to rounding."""
    sb3_contrib = pytest.importorskip("sb3_contrib")
    from stable_baselines3.common.logger import Logger

    size = 256
    peer = sb3_contrib.TRPO(
        "MlpPolicy",
        gymnasium.make("oodil/Hopper-v0"),
        n_steps=size,
        batch_size=size,
        cg_max_steps=100,  # to convergence: it starts from random noise, we start from zero
        # It averages the divergence over the action dimensions too: its Fisher matrix and region are a third of ours.
        cg_damping=0.1 / 3,
        target_kl=0.01 / 3,
        normalize_advantage=False,
        policy_kwargs={"net_arch": {"pi": [16, 16], "vf": [4]}},
        device="cpu",
    )
    peer.set_logger(Logger(None, []))
    ours = network(observation_dim=12, action_dim=3, hidden=(16, 16))
    ours.input_mean.zero_()  # sb3 has no input normalizer
    ours.input_scale.fill_(1.0)
    theirs = (peer.policy.mlp_extractor.policy_net[0], peer.policy.mlp_extractor.policy_net[2], peer.policy.action_net)
    with torch.no_grad():
        for layer, target in zip(ours.net.layers, theirs, strict=True):
            target.weight.copy_(layer.weight)
            target.bias.copy_(layer.bias)
        peer.policy.log_std.copy_(ours.log_std)
    observations, actions, log_probs, advantages = batch(ours, size)
    buffer = peer.rollout_buffer
    for i in range(size):
        buffer.add(observations[None, i].numpy(), actions[None, i].numpy(), 0.0, False, torch.zeros(1), log_probs[i])
    buffer.advantages[:] = advantages[:, None].numpy()

    before = parameters_of(ours)
    metrics = improve(ours, TrpoConfig(cg_iterations=100, fisher_every=1), observations, actions, log_probs, advantages)
    peer.train()
    assert metrics["step_fraction"] == 1.0, "the line searches differ after the first point"
    updated = [peer.policy.log_std if name == "log_std" else None for name, _ in ours.named_parameters()]
    layers = iter([p for layer in theirs for p in (layer.weight, layer.bias)])
    expected = torch.cat([(next(layers) if p is None else p).detach().reshape(-1) for p in updated])
    step, peer_step = parameters_of(ours) - before, expected - before
    assert float(step.norm()) > 0.01
    assert float((step - peer_step).norm() / peer_step.norm()) < 1e-4


@pytest.mark.parametrize("max_kl", [1e-3, 1e-2, 1e-1, 3.0])
def test_step_improves_and_stays_within_the_region(network, batch, max_kl):
    policy, before = network(), network()
    observations, actions, log_probs, advantages = batch(policy, 200)
    metrics = improve(policy, TrpoConfig(max_kl=max_kl), observations, actions, log_probs, advantages)
    divergence = mean_kl(policy, before, observations)
    assert 0 < divergence <= 1.5 * max_kl
    assert metrics["kl"] == pytest.approx(divergence, rel=1e-3)
    with torch.no_grad():
        ratio = torch.exp(policy.log_prob(policy(observations), actions) - log_probs)
    gain = float((ratio * advantages).mean() - advantages.mean())
    assert gain > 0
    assert metrics["improvement"] == pytest.approx(gain, rel=1e-3, abs=1e-6)
    entropy = float(Normal(torch.zeros(2), policy.log_std.detach().exp()).entropy().sum())
    assert metrics["entropy"] == pytest.approx(entropy, rel=1e-5)


def test_a_step_that_does_not_improve_enough_is_halved(network, batch):
    policy = network()
    metrics = improve(policy, TrpoConfig(max_kl=3.0), *batch(policy, 200))
    assert metrics["step_fraction"] in {0.5**k for k in range(1, 10)}


def test_a_step_that_leaves_the_region_is_halved(network, batch):
    """Little noise is good here, so the step shrinks the deviation, where divergence grows faster than its model.

    The full step improves, and only its divergence (8.0 for a region of 3) speaks against it.
    """
    policy, before = network(), network()
    observations, actions, log_probs, _ = batch(policy, 200)
    with torch.no_grad():
        noise = (actions - policy(observations)) * torch.exp(-policy.log_std)
    advantages = -noise.square().sum(-1)
    advantages = (advantages - advantages.mean()) / advantages.std()
    metrics = improve(policy, TrpoConfig(max_kl=3.0), observations, actions, log_probs, advantages)
    assert metrics["step_fraction"] == 0.5
    assert mean_kl(policy, before, observations) <= 1.5 * 3.0


def test_the_region_shrinks_with_what_remains(network, batch):
    """The step is proportional to the root of the region, so a quarter of it halves the step."""

    def moved(step_scale):
        policy = network()
        before = parameters_of(policy)
        improve(policy, TrpoConfig(max_kl=1e-4), *batch(policy, 200), step_scale=step_scale)
        return float((parameters_of(policy) - before).norm())

    full = moved(1.0)
    assert moved(0.25) == pytest.approx(full / 2, rel=1e-3)


def test_step_is_refused_when_no_point_improves_enough(network, batch):
    """One trial, and it would have to reach the linear promise in full, which this batch does not."""
    policy = network()
    data = batch(policy, 200)
    before = parameters_of(policy)
    refusing = TrpoConfig(max_kl=0.5, accept_ratio=1.0, backtracks=1)
    metrics = improve(policy, refusing, *data)
    assert (metrics["step_fraction"], metrics["kl"], metrics["improvement"]) == (0.0, 0.0, 0.0)
    assert torch.equal(parameters_of(policy), before)
    accepting = refusing.model_copy(update={"accept_ratio": 0.0})
    assert improve(policy, accepting, *data)["step_fraction"] == 1.0
    assert not torch.equal(parameters_of(policy), before)


def test_step_is_refused_without_any_advantage(network, batch):
    policy = network()
    observations, actions, log_probs, _ = batch(policy, 50)
    before = parameters_of(policy)
    metrics = improve(policy, TrpoConfig(), observations, actions, log_probs, torch.zeros(50))
    assert metrics["step_fraction"] == 0.0
    assert torch.equal(parameters_of(policy), before)


@pytest.mark.parametrize("broken", ["observations", "actions", "log_probs", "advantages"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_broken_numbers_leave_the_policy_untouched(network, batch, broken, value):
    policy = network()
    arguments = dict(zip(("observations", "actions", "log_probs", "advantages"), batch(policy, 50), strict=True))
    arguments[broken].view(-1)[3] = value
    before = parameters_of(policy)
    metrics = improve(policy, TrpoConfig(), **arguments)
    after = parameters_of(policy)
    if torch.equal(after, before):
        assert metrics["step_fraction"] == 0.0
    else:  # an infinite old log-probability only means a ratio of zero, which is sound
        assert (broken, value) == ("log_probs", float("inf"))
        assert torch.isfinite(after).all()


def test_log_probabilities_of_an_older_policy_weigh_the_samples(network, batch):
    """With lag 1 the ratio starts away from one: samples the old policy favored count less."""
    policy = network()
    observations, actions, log_probs, advantages = batch(policy, 100)
    older = log_probs + 0.5 * torch.randn(100, generator=torch.Generator().manual_seed(5))
    weighed = network()
    improve(weighed, TrpoConfig(), observations, actions, older, advantages)
    equivalent = network()
    ratio = torch.exp(log_probs - older)
    improve(equivalent, TrpoConfig(), observations, actions, log_probs, advantages * ratio)
    torch.testing.assert_close(parameters_of(weighed), parameters_of(equivalent), rtol=1e-3, atol=1e-5)
