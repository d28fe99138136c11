"""The walk-through of docs/your-own-data.md, command by command: from a Minari data set to scores and a policy."""

import csv
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import minari
import numpy as np
import pytest
from minari.data_collector import EpisodeBuffer
from safetensors.numpy import load_file

from oodil.pipeline.environments import make_batch
from tests.minari_sets import save_minari
from tests.runs import ROOT

pytestmark = pytest.mark.timeout(300)

DATA_SET = "mine/hopper-v0"
SMALL = """clustering.num_clusters=2 clustering.joint_iterations=15 transferability.gail.total_steps=8000
transferability.gail.num_groups=2 evaluation.num_scores=4 imitation.gail.total_steps=8000
imitation.num_trainings=1 imitation.num_candidates=2 evaluation.num_points=1 evaluation.final_episodes=2"""


def make_data_set() -> None:
    """Eight episodes of random actions, of unequal length."""
    simulators = make_batch("oodil/Hopper-v0", {"gravity": 9.8}, 8)
    rng = np.random.default_rng(0)
    states, actions = [], []
    for g in range(8):
        simulators.reset(g, seed=g)
    for _ in range(60):
        states.append(simulators.observations().astype(np.float32))
        actions.append(0.1 * rng.standard_normal((8, 3), dtype=np.float32))
        simulators.step(actions[-1])
    buffers = []
    for g in range(8):
        length = 40 + 2 * g
        ends = np.arange(length - 1) == length - 2
        buffers.append(
            EpisodeBuffer(
                observations=np.stack(states)[:length, g],
                actions=np.stack(actions)[: length - 1, g],
                rewards=np.ones(length - 1),
                terminations=np.zeros(length - 1, np.bool_),
                truncations=ends,
            )
        )
    save_minari(DATA_SET, buffers)


def test_the_walk_through(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    (tmp_path / "minari").mkdir()
    make_data_set()
    blocks = re.findall(r"```(\w*)\n(.*?)```", (ROOT / "docs" / "your-own-data.md").read_text(), re.S)
    (configuration,) = [text for language, text in blocks if language == "yaml"]
    (tmp_path / "mine.yaml").write_text(configuration)
    commands = [
        words[1:]
        for language, text in blocks
        for line in text.splitlines()
        if not language and (words := shlex.split(line, comments=True)) and not any("lab-" in word for word in words)
    ]
    assert [words[:2] for words in commands] == [
        ["demos", "convert"],
        ["demos", "inspect"],
        ["run", "mine.yaml"],
        ["demos", "export"],
        ["demos", "export"],
    ]
    for words in commands:
        small = SMALL.split() if words[0] == "run" else []
        command = [sys.executable, str(ROOT / "orchestrator.py"), *words, *small]
        ended = subprocess.run(command, cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True)
        assert ended.returncode == 0, (words, ended.stdout, ended.stderr)
    with open(tmp_path / "scores.csv") as file:
        rows = list(csv.DictReader(file))
    scores = [float(row["transferability"]) for row in rows]
    assert len(rows) == 8 and all(0 < score < 1 for score in scores)
    assert sum(float(row["weight"]) for row in rows) == pytest.approx(1)
    told = [
        episode["oodil_transferability"]
        for episode in minari.load_dataset(DATA_SET).storage.get_episode_metadata(range(8))
    ]
    assert told == pytest.approx(scores)
    policy = load_file(tmp_path / "runs" / "mine-seed0" / "stages" / "imitation" / "policy.safetensors")
    assert policy["weight_0"].shape[0] == 12
