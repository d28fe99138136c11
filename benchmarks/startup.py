"""How long a user waits before anything is learned: importing, the command line's help, the smallest run.

import: processor time of ``import oodil`` beside a bare interpreter's; help: that of ``oodil --help``; smoke: wall time
of ``oodil run smoke --workers 2`` in a fresh folder. Each is a process of its own, in turns, after a round of the short
ones that does not count. Run ``python benchmarks/startup.py --json FILE``.
"""

import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import OODIL, arguments_of, circumstances, save

PARTS = ("import", "help", "smoke")
COMMANDS = {
    "bare": [sys.executable, "-c", "pass"],
    "import": [sys.executable, "-c", "import oodil"],
    "help": [*OODIL, "--help"],
}


def processor_seconds(command: list[str]) -> float:
    """Return the processor time of a command that starts no process. Raises CalledProcessError when it fails."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def smoke_seconds() -> float:
    """Return the wall time of the smallest run with two workers."""
    with tempfile.TemporaryDirectory() as folder:
        command = [*OODIL, "run", "smoke", "--workers", "2", "--run-dir", str(Path(folder) / "run")]
        started = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return time.perf_counter() - started


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    found = circumstances() | {"rounds": arguments.rounds}
    seen: dict[str, list[float]] = {part: [] for part in ("bare", *arguments.parts)}
    for part in COMMANDS:
        processor_seconds(COMMANDS[part])  # Files come from the disk, and bytecode is written.
    for _ in range(arguments.rounds):
        for part, seconds in seen.items():
            seconds.append(smoke_seconds() if part == "smoke" else processor_seconds(COMMANDS[part]))
    for part, seconds in seen.items():
        unit = "wall_s" if part == "smoke" else "processor_s"
        found[part] = {unit: {"min": min(seconds), "median": statistics.median(seconds)}}
        print(f"{part:8} {unit} at least {min(seconds):.3f}, median {statistics.median(seconds):.3f}", flush=True)
    save(arguments.json, found)


if __name__ == "__main__":
    main()
