"""Your own recordings in one file of demonstrations: two labs with carts of other masses than yours.

python examples/own_data.py [FILE.safetensors]     # default: carts.safetensors
"""

import sys
from pathlib import Path

import cart
import numpy as np

import oodil
from oodil.pipeline.data import Episode
from oodil.pipeline.datasets import encode_demonstrations

LABS = {"heavy cart": 1000.0, "light cart": 50.0}
"""Masses in kg. The imitator's is 900, so it is as quick as the one and can never be as quick as the other."""


def recordings(mass: float, count: int, seed: int = 0) -> list[np.ndarray]:
    """Return what a lab recorded, (T, 2) states each; a hand-made controller drives the cart."""
    env = cart.make(mass=mass)
    found = []
    for n in range(count):
        state, _ = env.reset(seed=seed + n)
        states = [state]
        for _ in range(100):
            force = np.clip(-500 * state[0] - 2 * (500 * mass) ** 0.5 * state[1], -cart.FORCE, cart.FORCE)
            state = env.step(np.array([force], np.float32))[0]
            states.append(state)
        found.append(np.array(states))
    return found


if __name__ == "__main__":
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "carts.safetensors")
    labs = [oodil.Demonstrations.of([Episode(s) for s in recordings(mass, 20)], name) for name, mass in LABS.items()]
    demonstrations = oodil.Demonstrations.joined(labs)
    path.write_bytes(encode_demonstrations(demonstrations, "cart:Cart-v0"))
    print(f"{path}: {len(demonstrations)} demonstrations of {', '.join(demonstrations.source_labels)}")
