"""An environment class of your own (cart.py) as the imitator's: a run on the recordings of own_data.py.

python examples/own_environment.py [DATA [RUN_DIR [KEY=VALUE...]]]     # default: carts.safetensors runs/cart
"""

import sys

import cart

import oodil

data = sys.argv[1] if len(sys.argv) > 1 else "carts.safetensors"
run_dir = sys.argv[2] if len(sys.argv) > 2 else "runs/cart"
config = {
    "name": "cart",
    "environment": {"id": "cart:Cart-v0", "dynamics": {"mass": 900.0}},
    "demonstrations": {"file": data},
    "clustering": {"num_clusters": 2},
    "transferability": {"gail": {"total_steps": 60_000}},
    "imitation": {"num_trainings": 1, "gail": {"total_steps": 60_000}},
}

# In this process alone: others would have to find cart.py, too, on PYTHONPATH.
run = oodil.run(config, sys.argv[3:], workers=0, run_dir=run_dir)

# What can this cart do of what the others did?
for source in run.verdicts().by_source:
    print(f"{source.name}: score {source.score:.3f}, kept {source.kept} of {source.demonstrations}")

# An episode of ours; actions are newtons.
policy, env = run.policy(), cart.make(mass=900.0)
observation, _ = env.reset(seed=0)
for _step in range(100):
    observation = env.step(policy.act(observation))[0]
print(f"after 5 s the cart is at {observation[0]:.2f} m")
