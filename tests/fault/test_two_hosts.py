"""A run and its worker on two hosts, as far as one machine can play two: network namespaces with a cable between."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from oodil.workers.channels import new_key_pair
from oodil.workers.keys import create_learner_keys, create_worker_keys
from tests.runs import MICRO, ROOT, LiveRun, artifacts, has_checkpoint, nothing_left, wait_for, without_baselines

pytestmark = [pytest.mark.root, pytest.mark.timeout(300)]

LAB, ELSEWHERE = "10.213.77.1", "10.213.77.2"
CUT_S = 3.0


@dataclass(frozen=True)
class Hosts:
    """Two network namespaces."""

    lab: str
    elsewhere: str

    def command(self, host: str) -> list[str]:
        """Return the words before a command that is run on a host."""
        return ["ip", "netns", "exec", host]

    def cable(self, state: str) -> None:
        """Pull the cable (``down``) or plug it in again (``up``)."""
        ip("-n", self.lab, "link", "set", "cable", state)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    made = Hosts(f"oodil-lab-{os.getpid()}", f"oodil-far-{os.getpid()}")
    if shutil.which("ip") is None or os.geteuid() != 0:
        pytest.skip("network namespaces need root and the program ip")
    try:
        ip("netns", "add", made.lab)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no network namespaces here: {error.stderr.decode().strip()}")
    try:
        ip("netns", "add", made.elsewhere)
        ip("-n", made.lab, "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", made.elsewhere)
        for host, address in ((made.lab, LAB), (made.elsewhere, ELSEWHERE)):
            ip("-n", host, "address", "add", f"{address}/24", "dev", "cable")
            ip("-n", host, "link", "set", "cable", "up")
        yield made
    finally:
        subprocess.run(["ip", "netns", "del", made.elsewhere], capture_output=True)
        ip("netns", "del", made.lab)


def test_the_cable_is_pulled_and_plugged_in_again(undisturbed: dict[str, str], hosts: Hosts, tmp_path: Path) -> None:
    """The only local rollout worker is frozen, so the final training lives on what comes over the cable."""
    keys = tmp_path / "keys"
    create_learner_keys(keys, new_key_pair)
    address, run_dir = f"tcp://{LAB}:5555", tmp_path / "joined"
    live = LiveRun(
        *("run", str(MICRO), "runtime.unit_timeout_s=600", "--workers", "1", "--run-dir", str(run_dir)),
        *("--bind", address, "--keys", str(keys)),
        before=hosts.command(hosts.lab),
    )
    command = [sys.executable, str(ROOT / "orchestrator.py"), "worker", "--connect", address]
    command += ["--keys", str(create_worker_keys(keys, "elsewhere", new_key_pair)), "--logs", str(tmp_path / "logs")]
    remote = subprocess.Popen(hosts.command(hosts.elsewhere) + command, stdout=subprocess.DEVNULL)
    try:
        live.child("imitation-rollout-worker-0").suspend()
        wait_for(has_checkpoint(run_dir, "imitation", "training-1", 3), "checkpoint made with the remote worker")
        hosts.cable("down")
        time.sleep(CUT_S)
        assert not (run_dir / "stages" / "imitation").exists(), "the run ended while the cable was out"
        hosts.cable("up")
        code, output = live.finish()
    finally:
        remote.terminate()
        remote.wait(timeout=30)
    assert code == 0, output
    nothing_left(live)
    assert artifacts(run_dir) == without_baselines(undisturbed)
