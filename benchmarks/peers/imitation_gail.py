"""GAIL of the `imitation` library, timed; run by the interpreter of its own environment, see benchmarks/README.md.

Usage: imitation_gail.py STEPS BATCH EPOCHS MINIBATCH. Prints one line of JSON.
"""

import json
import sys
import time
from importlib.metadata import version

import gymnasium
import numpy as np
import torch
from imitation.algorithms.adversarial.gail import GAIL
from imitation.data.types import Transitions
from imitation.rewards.reward_nets import BasicRewardNet
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

SIMULATORS = 8
WARM_UP = 0.3


def make_env() -> gymnasium.Env:
    """Return the Hopper with root x in its observation."""
    return gymnasium.make("Hopper-v4", exclude_current_positions_from_observation=False)


def random_transitions(count: int) -> Transitions:
    """Return transitions of random actions; what is imitated does not matter for speed."""
    env = make_env()
    env.action_space.seed(0)
    states, actions, successors = [], [], []
    state = env.reset(seed=0)[0]
    for _ in range(count):
        action = env.action_space.sample()
        successor, _, terminated, truncated, _ = env.step(action)
        states.append(state)
        actions.append(action)
        successors.append(successor)
        state = env.reset()[0] if terminated or truncated else successor
    return Transitions(
        obs=np.array(states),
        acts=np.array(actions),
        infos=np.array([{}] * count),
        next_obs=np.array(successors),
        dones=np.zeros(count, bool),
    )


def main() -> None:
    """Train and print steps per second after the warm-up."""
    steps, batch, epochs, minibatch = (int(argument) for argument in sys.argv[1:])
    torch.set_num_threads(1)
    venv = DummyVecEnv([make_env] * SIMULATORS)
    generator = PPO(
        "MlpPolicy",
        venv,
        n_steps=batch // SIMULATORS,
        batch_size=minibatch,
        n_epochs=epochs,
        gamma=0.995,
        gae_lambda=0.97,
        learning_rate=3e-4,
        policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}},
        device="cpu",
        seed=0,
    )
    reward = BasicRewardNet(
        venv.observation_space, venv.action_space, use_action=False, use_next_state=True, hid_sizes=(64, 64)
    )
    trainer = GAIL(
        demonstrations=random_transitions(10_000),
        demo_batch_size=batch,
        gen_train_timesteps=batch,
        gen_replay_buffer_capacity=batch,
        n_disc_updates_per_round=1,
        venv=venv,
        gen_algo=generator,
        reward_net=reward,
        allow_variable_horizon=True,
    )
    rounds = max(2, steps // batch)
    times = [time.perf_counter()]
    trainer.train(rounds * batch, callback=lambda _: times.append(time.perf_counter()))
    first = int(WARM_UP * rounds)
    rate = (rounds - first) * batch / (times[-1] - times[first])
    versions = {
        name: version(name) for name in ("imitation", "stable-baselines3", "gymnasium", "torch", "mujoco", "numpy")
    }
    print(json.dumps({"steps_per_s": rate, "rounds": rounds, "versions": versions}))


if __name__ == "__main__":
    main()
