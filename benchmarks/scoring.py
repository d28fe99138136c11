"""What ``oodil score`` takes for many demonstrations: seconds by weighting, and how far memory rises.

They are the run's own states with a little noise, again and again, so that all of them are read. Run
``python benchmarks/scoring.py RUN_DIR --json FILE``. Peak memory is the process's, before scoring and after it.
"""

import resource
import time
from pathlib import Path

import numpy as np
from common import arguments_of, circumstances, one_thread, save

import oodil
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.errors import OodilError


def later(known: Demonstrations, count: int, steps: int) -> Demonstrations:
    """Return demonstrations like those that are known, each of them repeated until it has so many steps."""
    rng = np.random.default_rng(0)
    deviation = 1e-4 * known.observations.std(axis=0)
    episodes = []
    for n in range(count):
        states = np.resize(known[n % len(known)], (steps + 1, known.observation_dim))
        episodes.append(Episode(states + deviation * rng.standard_normal(states.shape, dtype=np.float32)))
    return Demonstrations.of(episodes, "later")


def peak_megabytes() -> float:
    """Return the most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--demonstrations", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=1000)
    arguments = parser.parse_args()
    one_thread()
    found = circumstances()
    results = oodil.open_run(arguments.run_dir)
    oodil.score(results, later(results.demonstrations, 2, arguments.steps))  # Libraries are loaded.
    demonstrations = later(results.demonstrations, arguments.demonstrations, arguments.steps)
    found |= {
        "environment": results.config.environment.id,
        "known_demonstrations": len(results.demonstrations),
        "demonstrations": arguments.demonstrations,
        "steps": arguments.steps,
        "megabytes_of_states": demonstrations.observations.nbytes / 2**20,
        "peak_megabytes_before": peak_megabytes(),
        "weightings": {},
    }
    for weighting in results.weightings:
        started = time.perf_counter()
        try:
            scored = oodil.score(results, demonstrations, weighting.name).found[weighting.name]
        except OodilError as error:
            print(error)
            continue
        figures = {
            "seconds": time.perf_counter() - started,
            "peak_megabytes": peak_megabytes(),
            "with_a_score": int(np.isfinite(scored.scores).sum()),
        }
        found["weightings"][weighting.name] = figures
        print(weighting.name, figures, flush=True)
    print(f"before: {found['peak_megabytes_before']:.0f} MB, of which states {found['megabytes_of_states']:.0f} MB")
    save(arguments.json, found)


if __name__ == "__main__":
    main()
