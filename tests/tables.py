"""A small experiment: two rows that share all but the last policy, two seeds; nothing is learned."""

from pathlib import Path
from typing import Any

import yaml

SHORT = [
    "transferability.gail.total_steps=1_600",
    "transferability.gail.steps_per_rollout=20",
    "transferability.reading.steps=5",
    "imitation.gail.total_steps=3_200",
    "imitation.gail.steps_per_rollout=20",
    "clustering.num_clusters=1",
    "evaluation.num_points=1",
    "evaluation.final_episodes=2",
    "runtime.checkpoint_interval_s=0",
    "runtime.restart_delay_s=0.1",
]
_VALUES: dict[str, Any] = {
    "name": "micro",
    "run": "quick/driving",
    "overrides": SHORT,
    "rows": {"some": [], "all": ["transferability.kept_from=0"]},
    "methods": ["naive_gail", {"name": "ours", "policy": "imitation"}],
    "seeds": "0-1",
    "measure": "mean_return",
    "published": {"all": {"ours": 3000}},
}
RUNS = {"some-seed0", "some-seed1", "all-seed0", "all-seed1"}


def write_experiment(folder: Path, **changes: Any) -> Path:
    """Write the experiment with some changes; return its file."""
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(_VALUES | changes, sort_keys=False))
    return path
