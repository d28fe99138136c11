"""The quick variant of every environment's configuration goes through the whole pipeline, and again for nothing."""

import json
import math
from pathlib import Path

import pytest

from tests.runs import ROOT, artifacts, run

pytestmark = pytest.mark.timeout(300)


@pytest.mark.parametrize("config", sorted((ROOT / "configs" / "quick").glob("*.yaml")), ids=lambda path: path.stem)
def test_a_quick_run(config: Path, tmp_path: Path) -> None:
    command = ("run", str(config), "--run-dir", str(tmp_path / "run"), "--workers", "0")
    run(*command)
    before = artifacts(tmp_path / "run")
    results = json.loads(run("status", str(tmp_path / "run"), "--json"))["results"]
    assert len(results["policies"]) > 1 and "imitation" in results["policies"]
    assert all(math.isfinite(policy["mean_return"]) for policy in results["policies"].values())
    assert 0 < results["purity"] <= 1
    assert (tmp_path / "run" / "report.html").stat().st_size > 50_000
    assert run(*command).count("reused") == len(before)
    assert artifacts(tmp_path / "run") == before
