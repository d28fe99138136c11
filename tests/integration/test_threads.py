"""Whoever calls and however many threads it computes with: the same bits, and its own settings afterwards."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from threadpoolctl import threadpool_info

from oodil.workers.threads import one_thread
from tests.runs import MICRO, ROOT

pytestmark = pytest.mark.timeout(240)

SCRIPT = """
import sys
import numpy, torch
from threadpoolctl import threadpool_info
import oodil
from oodil.workers.reports import Progress

threads = int(sys.argv[2])
assert torch.get_num_threads() == threads
before = {pool["filepath"]: pool["num_threads"] for pool in threadpool_info()}
seen = set()


class Watch(oodil.Observer):
    # Inline, a job reports from where it computes.
    def event(self, event):
        if isinstance(event.report, Progress):
            seen.add(torch.get_num_threads())
            seen.update(pool["num_threads"] for pool in threadpool_info())


oodil.run(sys.argv[1], workers=0, run_dir=sys.argv[3], observer=Watch())
assert seen == {1}, seen
assert torch.get_num_threads() == threads
after = {pool["filepath"]: pool["num_threads"] for pool in threadpool_info()}
assert threads in before.values() and before.items() <= after.items(), (before, after)
"""


def test_an_inline_run_does_not_depend_on_the_threads_of_its_caller(tmp_path: Path) -> None:
    hashes = set()
    for threads in (1, 2):
        number = str(threads)
        environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), number)
        run_dir = tmp_path / number
        command = [sys.executable, "-c", SCRIPT, str(MICRO), number, str(run_dir)]
        subprocess.run(command, env=environment, cwd=ROOT, check=True, timeout=110)
        policy = run_dir / "stages" / "imitation" / "policy.safetensors"
        hashes.add(hashlib.sha256(policy.read_bytes()).hexdigest())
    assert len(hashes) == 1


def test_what_was_set_before_is_set_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    torch.set_num_threads(2)
    try:
        with pytest.raises(ArithmeticError), one_thread():
            assert torch.get_num_threads() == 1
            assert {pool["num_threads"] for pool in threadpool_info()} == {1}
            assert os.environ["OMP_NUM_THREADS"] == os.environ["MKL_NUM_THREADS"] == "1"
            raise ArithmeticError
        assert torch.get_num_threads() == 2
        assert os.environ["OMP_NUM_THREADS"] == "3" and "MKL_NUM_THREADS" not in os.environ
    finally:
        torch.set_num_threads(1)
