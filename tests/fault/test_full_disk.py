"""A disk that is full while checkpoints and artifacts are written: one clear error, and nothing is lost."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.runs import MICRO, LiveRun, artifacts, run, without_baselines

pytestmark = [pytest.mark.root, pytest.mark.timeout(300)]
SETTINGS = ("baselines=[]", "runtime.max_attempts=1")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Give a file system of its own with room for hardly more than the demonstrations."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=900k", "none", str(folder)], capture_output=True)
    if mounted.returncode:
        pytest.skip("this user may not mount a file system")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_full_disk_stops_the_run_and_a_resumed_one_goes_on(undisturbed: dict[str, str], small_disk: Path) -> None:
    run_dir = small_disk / "run"
    code, output = LiveRun("run", str(MICRO), *SETTINGS, "--run-dir", str(run_dir), "--workers", "1").finish()
    assert code == 1, output
    assert "No space left on device" in output and "oodil resume" in output
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    run("resume", str(run_dir), "--workers", "1")
    assert artifacts(run_dir) == without_baselines(undisturbed)
