"""Whether any process of a run grows: the learner loop with two rollout workers for an hour, watched from outside.

Prints the resident memory of every process each minute, and at the end how much each grew since the warm-up.
"""

# ruff: noqa: E402  (the program may not be installed)
import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import psutil

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.throughput import machine
from oodil.pipeline.versions import library_versions

WARM_UP = 0.15
"""Share of the time that is not judged: libraries load, caches and the lists of the progress display fill."""


def resident_megabytes(root: psutil.Process) -> dict[str, float]:
    """Return the resident memory of a process and all below it, by name."""
    found = {}
    for process in [root, *root.children(recursive=True)]:
        try:
            name = "orchestrator" if process == root else role(process)
            found[f"{name} {process.pid}"] = process.memory_info().rss / 1e6
        except psutil.NoSuchProcess:
            continue
    return found


def role(process: psutil.Process) -> str:
    """Return what a child is, by the log it writes; multiprocessing's own helper has none."""
    logs = [Path(file.path).name for file in process.open_files() if "/logs/" in file.path]
    return logs[0].rsplit(".", 2)[0] if logs else "resource tracker"


def growth(minutes: list[float], megabytes: list[float]) -> float:
    """Return the slope in megabytes per hour, by least squares."""
    return float(np.polyfit(np.array(minutes) / 60, megabytes, 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--minutes", type=float, default=60.0)
    arguments = parser.parse_args()
    seen: dict[str, list[tuple[float, float]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        # The budget has no end; the run is stopped when the time is over.
        command = [sys.executable, str(ROOT / "orchestrator.py"), "run", str(ROOT / "configs" / "smoke.yaml")]
        command += ["imitation.gail.total_steps=1_000_000_000", "baselines=[]", "--workers", "2"]
        command += ["evaluation.num_points=1000", "--run-dir", str(Path(folder) / "run")]
        run = psutil.Popen(command, stdout=subprocess.DEVNULL)
        while not (Path(folder) / "run" / "logs" / "imitation-imitation.1.log").exists():
            time.sleep(1)
        started = time.monotonic()
        while (minute := (time.monotonic() - started) / 60) < arguments.minutes:
            now = resident_megabytes(run)
            for name, megabytes in now.items():
                seen[name].append((minute, megabytes))
            told = "  ".join(f"{name} {megabytes:.0f} MB" for name, megabytes in now.items())
            print(f"{minute:5.1f} min  {told}", flush=True)
            time.sleep(min(60.0, arguments.minutes * 6))
        run.terminate()
        run.wait(timeout=600)
    judged: dict[str, Any] = {}
    for name, points in seen.items():
        late = [(minute, megabytes) for minute, megabytes in points if minute > WARM_UP * arguments.minutes]
        if len(late) > 2:
            minutes, megabytes = map(list, zip(*late, strict=True))
            first, last, slope = megabytes[0], megabytes[-1], growth(minutes, megabytes)
            judged[name] = {"first_mb": first, "last_mb": last, "mb_per_hour": slope}
            print(f"{name}: {first:.0f} -> {last:.0f} MB, {slope:+.1f} MB per hour")
    if arguments.json:
        found = {"machine": machine(), "versions": library_versions(), "minutes": arguments.minutes}
        arguments.json.write_text(json.dumps(found | {"processes": judged}, indent=2) + "\n")


if __name__ == "__main__":
    main()
