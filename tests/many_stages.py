"""Tells a display of a run of hundreds of stages and jobs, faster than any real one; a busy thread gets in between."""

import sys
import threading

from oodil.cli.encoding import fit_encoding
from oodil.estimate import RunCost, StageCost
from oodil.terminal import Display
from oodil.workers.reports import DONE, AttemptFailed, Event, Finished, Progress, Started, Warn

METRICS = {"return": 1234.5, "length": 111.25, "value_loss": 16.333}


def main(stages: int, jobs: int) -> None:
    """Run that many stages of that many jobs, two at a time."""
    costs = {f"stage-{n}": StageCost(1_000, 1.0, jobs) for n in range(stages)}
    over = threading.Event()
    sys.setswitchinterval(1e-4)  # Or each line would wait for the busy thread.
    threading.Thread(target=lambda: [sum(range(1000)) for _ in iter(over.is_set, True)], daemon=True).start()
    now = 0.0
    with Display(RunCost(costs, 2), clock=lambda: now) as display:
        for n, stage in enumerate(costs):
            display.stage_started(stage, "", jobs)
            for first in range(0, jobs, 2):
                pair = [f"cluster-{first}", f"cluster-{first + 1}-training-2"]
                for job in pair:
                    display.event(Event(job, Started(1)))
                for done in (0, 4_000, 9_000, 10_000):
                    for job in pair:
                        now += 0.25
                        display.event(Event(job, Progress(done, 10_000, METRICS)))
                for job in pair:
                    display.event(Event(job, Finished(DONE)))
            if n % 50 == 0:
                display.event(Event("cluster-0", Warn(f"warning {n} [of a kind] " + "that is long " * 12)))
                display.event(Event("cluster-0", AttemptFailed(1, "", True)))
                print(f"printed {n}")
            display.stage_finished(stage, 1.0)
    over.set()


if __name__ == "__main__":
    fit_encoding()
    main(*map(int, sys.argv[1:]))
