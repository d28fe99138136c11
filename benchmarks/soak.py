"""Whether any process of a run grows: the learner loop with two rollout workers for an hour, watched from outside.

Prints the resident memory of every process each minute, and at the end how much each grew since the warm-up. What
the fork server has loaded is shared, and counts for each. Run ``python benchmarks/soak.py --json FILE``.
"""

import subprocess
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import psutil
from common import OODIL, arguments_of, circumstances, save

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
    """Return what a child is, by the log it writes; the fork server has none."""
    logs = [Path(file.path).name for file in process.open_files() if "/logs/" in file.path]
    return logs[0].rsplit(".", 2)[0] if logs else "fork server"


def growth(minutes: list[float], megabytes: list[float]) -> float:
    """Return the slope in megabytes per hour, by least squares."""
    return float(np.polyfit(np.array(minutes) / 60, megabytes, 1)[0])


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    arguments = parser.parse_args()
    found = circumstances() | {"minutes": arguments.minutes, "processes": {}}
    seen: dict[str, list[tuple[float, float]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        # The budget has no end; the run is stopped when the time is over.
        command = [*OODIL, "run", "smoke", "imitation.gail.total_steps=1_000_000_000", "baselines=[]"]
        command += ["--workers", "2"]
        command += ["evaluation.num_points=1000", "--run-dir", str(Path(folder) / "run")]
        run = psutil.Popen(command, stdout=subprocess.DEVNULL)
        logs = Path(folder) / "run" / "logs"
        while not any(logs.glob("imitation-training-1.*.log")):
            if run.poll() is not None:
                raise SystemExit(f"the run ended by itself: exit code {run.poll()}")
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
    for name, points in seen.items():
        late = [(minute, megabytes) for minute, megabytes in points if minute > WARM_UP * arguments.minutes]
        if len(late) > 2:
            slope = growth([minute for minute, _ in late], [megabytes for _, megabytes in late])
            first, last = late[0][1], late[-1][1]
            found["processes"][name] = {"first_mb": first, "last_mb": last, "mb_per_hour": slope}
            print(f"{name}: {first:.0f} -> {last:.0f} MB, {slope:+.1f} MB per hour")
    save(arguments.json, found)


if __name__ == "__main__":
    main()
