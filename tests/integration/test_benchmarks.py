"""Scripts of `benchmarks/` that need no run, as they are started, on as little as they can be given."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.runs import ROOT

pytestmark = pytest.mark.timeout(300)


def figures_of(script: str, *arguments: str, file: Path) -> dict[str, Any]:
    """Start a script and return what it wrote."""
    command = [sys.executable, str(ROOT / "benchmarks" / script), *arguments, "--json", str(file)]
    path = os.pathsep.join((str(ROOT / "src"), os.environ.get("PYTHONPATH", "")))
    done = subprocess.run(
        command, cwd=file.parent, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(file.read_text())
    assert found["machine"]["time"] and found["versions"]["python"]
    return found


def test_the_physical_check(tmp_path: Path) -> None:
    found = figures_of("reproducibility.py", "--configs", "quickstart", "--count", "1", file=tmp_path / "found.json")
    (hopper,) = found["environments"]
    assert hopper["environment"] == "oodil/Hopper-v0" and hopper["demonstrations"] == 4
    assert hopper["auroc_one_step"] == 1.0


def test_one_source_alone_goes_on_and_refuses_other_settings(tmp_path: Path) -> None:
    file = tmp_path / "found.json"
    short = "driving", "--processes", "1", "--set", "total_steps=2560"
    (first,) = figures_of("gail_reference.py", *short, "--seeds", "0", file=file)["seeds"]
    both = figures_of("gail_reference.py", *short, "--seeds", "0-1", file=file)["seeds"]
    assert both[0] == first and [(each["task"], each["seed"]) for each in both] == [("driving", 0), ("driving", 1)]
    before = file.read_bytes()
    with pytest.raises(AssertionError, match=r"was made with set \['total_steps=2560'\]"):
        figures_of("gail_reference.py", "driving", "--seeds", "0", file=file)
    assert file.read_bytes() == before
