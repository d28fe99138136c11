"""From demonstrations to a policy in Python: run a configuration, read its verdicts, act with what was learned.

python examples/quickstart.py [CONFIG [RUN_DIR]]     # names: `oodil configs`; default: smoke, which learns nothing
"""

import sys

import gymnasium

import oodil

config = sys.argv[1] if len(sys.argv) > 1 else "smoke"
run_dir = sys.argv[2] if len(sys.argv) > 2 else None  # default: runs/NAME-seedSEED

# Like the command, it resumes what was interrupted and reuses what is finished.
run = oodil.run(config, run_dir=run_dir)

# Which demonstrations can your robot reproduce? The ten that weigh most.
for row in sorted(run.table(), key=lambda row: -row["weight"])[:10]:
    print(
        f"demonstration {row['demonstration']:>3} ({row['source']}, cluster {row['cluster']}): "
        f"transferability {row['transferability']:.3f}, weight {row['weight']:.3f}"
    )

# One episode with the policy in the imitator's own environment.
policy = run.policy()
env = gymnasium.make("oodil/Hopper-v0", gravity=12.0)
observation, _ = env.reset(seed=0)
env_return, ended = 0.0, False
while not ended:
    observation, reward, terminated, truncated, _ = env.step(policy.act(observation))
    env_return, ended = env_return + float(reward), terminated or truncated
print(f"one episode: return {env_return:.0f}")

# 32 fresh episodes of each policy of the run, as `oodil evaluate` has them.
for each in run.policies:
    seen = oodil.evaluate(run.policy(each.name), "oodil/Hopper-v0", {"gravity": 12.0}, episodes=32)
    print(f"{each.title}: return {seen.mean_return:.0f} ± {seen.std_return:.0f} over {len(seen)} episodes")
