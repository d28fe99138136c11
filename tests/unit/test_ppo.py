"""PPO against values computed by hand and against stable-baselines3's."""

import math

import gymnasium
import pytest
import torch

import oodil.pipeline.environments  # noqa: F401  (registers the ids)
from oodil.pipeline.algorithms.ppo import Ppo, clipped_surrogate
from oodil.pipeline.config import PpoConfig


def improve(policy, config, observations, actions, log_probs, advantages, step_scale=1.0):
    rng = torch.Generator().manual_seed(0)
    return Ppo(policy, config).update(observations, actions, log_probs, advantages, rng, step_scale)


def parameters_of(policy):
    return torch.cat([p.detach().reshape(-1) for p in policy.parameters()])


def test_clipped_surrogate_by_hand():
    # ratio, advantage -> min(r A, clip(r, 0.8, 1.2) A):
    #   1.5,  2 -> min( 3.0,  2.4) =  2.4   clipped: no reward for going further up
    #   1.5, -2 -> min(-3.0, -2.4) = -3.0   not clipped: harm counts in full
    #   0.5,  2 -> min( 1.0,  1.6) =  1.0   not clipped
    #   0.5, -2 -> min(-1.0, -1.6) = -1.6   clipped: no reward for going further down
    #   1.0,  3 ->                    3.0
    old = torch.tensor([-1.0, -2.0, 0.5, 0.0, -3.0])
    new = old + torch.log(torch.tensor([1.5, 1.5, 0.5, 0.5, 1.0]))
    advantages = torch.tensor([2.0, -2.0, 2.0, -2.0, 3.0])
    value = clipped_surrogate(new, old, advantages, clip=0.2)
    assert float(value) == pytest.approx((2.4 - 3.0 + 1.0 - 1.6 + 3.0) / 5)


def test_clipped_samples_have_no_gradient():
    new = torch.log(torch.tensor([1.5, 1.5, 0.5, 0.5])).requires_grad_()
    clipped_surrogate(new, torch.zeros(4), torch.tensor([2.0, -2.0, 2.0, -2.0]), 0.2).backward()
    # d(r A)/d log r = r A, divided by the four samples; zero where the clip is active.
    torch.testing.assert_close(new.grad, torch.tensor([0.0, -3.0, 1.0, 0.0]) / 4)


@pytest.mark.parametrize(("epochs", "entropy_bonus"), [(1, 0.0), (6, 0.02)])
def test_update_equals_stable_baselines3(network, batch, epochs, entropy_bonus):
    """Same weights, batch and advantages; whole-batch steps, so that the order of the samples does not matter."""
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.logger import Logger

    size, rate = 128, 3e-3
    peer = stable_baselines3.PPO(
        "MlpPolicy",
        gymnasium.make("oodil/Hopper-v0"),
        learning_rate=rate,
        n_steps=size,
        batch_size=size,
        n_epochs=epochs,
        ent_coef=entropy_bonus,
        vf_coef=0.0,
        max_grad_norm=0.5,
        normalize_advantage=False,
        policy_kwargs={"net_arch": {"pi": [16, 16], "vf": [4]}, "optimizer_kwargs": {"eps": 1e-8}},
        device="cpu",
    )
    peer.set_logger(Logger(None, []))
    ours = network(observation_dim=12, action_dim=3, hidden=(16, 16))
    ours.input_mean.zero_()  # sb3 has no input normalizer
    ours.input_scale.fill_(1.0)
    extractor = peer.policy.mlp_extractor.policy_net
    theirs = (extractor[0], extractor[2], peer.policy.action_net)
    with torch.no_grad():
        for layer, target in zip(ours.net.layers, theirs, strict=True):
            target.weight.copy_(layer.weight)
            target.bias.copy_(layer.bias)
        peer.policy.log_std.copy_(ours.log_std)
    observations, actions, log_probs, advantages = batch(ours, size)
    advantages = 10 * advantages  # so that the gradient's norm is above the limit
    for i in range(size):
        peer.rollout_buffer.add(
            observations[None, i].numpy(), actions[None, i].numpy(), 0.0, False, torch.zeros(1), log_probs[i]
        )
    peer.rollout_buffer.advantages[:] = advantages[:, None].numpy()

    before = parameters_of(ours)
    config = PpoConfig(
        learning_rate=rate, epochs=epochs, minibatch_size=size, entropy_bonus=entropy_bonus, max_grad_norm=0.5
    )
    improve(ours, config, observations, actions, log_probs, advantages)
    peer.train()
    assert (parameters_of(ours) - before).abs().max() > 0.9 * rate
    for layer, target in zip(ours.net.layers, theirs, strict=True):
        torch.testing.assert_close(layer.weight, target.weight, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(layer.bias, target.bias, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours.log_std, peer.policy.log_std, rtol=1e-4, atol=1e-5)


def test_every_epoch_sees_every_sample_once(network, batch, monkeypatch):
    policy = network()
    observations, actions, log_probs, _ = batch(policy, 50)
    marks = torch.arange(50.0)
    seen = []

    def spy(new, old, advantages, clip):
        seen.append(advantages.clone())
        return clipped_surrogate(new, old, advantages, clip)

    monkeypatch.setattr("oodil.pipeline.algorithms.ppo.clipped_surrogate", spy)
    improve(policy, PpoConfig(epochs=2, minibatch_size=16), observations, actions, log_probs, marks)
    assert [len(part) for part in seen] == [16, 16, 16, 2] * 2
    first, second = torch.cat(seen[:4]), torch.cat(seen[4:])
    assert torch.equal(first.sort().values, marks)
    assert torch.equal(second.sort().values, marks)
    assert not torch.equal(first, second)


def test_step_scale_multiplies_the_step_size(network, batch):
    """Adam's first step moves each parameter by about its step size, whatever the gradient."""

    def moved(step_scale):
        policy = network()
        before = parameters_of(policy)
        config = PpoConfig(learning_rate=1e-2, epochs=1, minibatch_size=50)
        improve(policy, config, *batch(policy, 50), step_scale=step_scale)
        return float((parameters_of(policy) - before).abs().max())

    assert moved(1.0) == pytest.approx(1e-2, rel=1e-2)
    assert moved(0.25) == pytest.approx(0.25e-2, rel=1e-2)


def test_metrics(network, batch):
    policy = network()
    data = batch(policy, 64)
    metrics = improve(policy, PpoConfig(learning_rate=1e-12, epochs=1, minibatch_size=64), *data)
    assert metrics["kl"] == pytest.approx(0.0, abs=1e-6)
    # Entropy of a diagonal Gaussian: sum of log std plus log(2 pi e) / 2 per dimension.
    expected = float(policy.log_std.detach().sum()) + 2 * 0.5 * math.log(2 * math.pi * math.e)
    assert metrics["entropy"] == pytest.approx(expected, rel=1e-6)
