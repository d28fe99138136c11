"""A small experiment: two rows that share all but the last policy, two seeds; nothing is learned."""

from pathlib import Path
from typing import Any

import yaml

from tests.runs import MICRO

SHORT = [
    "transferability.gail.total_steps=2_000",
    "imitation.gail.total_steps=4_000",
    "evaluation.num_points=1",
    "clustering.num_clusters=1",
]
_VALUES: dict[str, Any] = {
    "name": "micro",
    "run": str(MICRO),
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
