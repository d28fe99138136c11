"""How many units one learner can take in, and with how many rollout workers that is reached.

Synthetic workers answer at once with a rollout that was collected beforehand, so all that is left is the learner's
side: sending, receiving, decoding, deciding who gets what. Beside it, what a unit costs a real worker and what the
update costs the learner, from which docs/scaling.md computes where one learner stops being enough. Run
``python benchmarks/intake.py --json FILE``.
"""

import multiprocessing
import statistics
import tempfile
import time
from dataclasses import replace
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments_of, circumstances, one_thread, run_config, save

from oodil.bench import random_demonstrations
from oodil.pipeline.algorithms.gail import AdversarialReward, imitator
from oodil.pipeline.algorithms.learner import Learner
from oodil.pipeline.collecting import collect
from oodil.pipeline.config import EnvironmentConfig
from oodil.pipeline.data import TransitionBatch, Unit, UnitResult
from oodil.pipeline.environments import environment_spec
from oodil.pipeline.seeding import derive_key
from oodil.pipeline.versions import collecting_versions
from oodil.workers.channels import Dealer, private_endpoint
from oodil.workers.messages import Header, Ready, ResultMessage, UnitMessage, decode, encode
from oodil.workers.zmq_rollouts import ZmqRollouts

UNITS_PER_WORKER = 4
"""In one iteration, so that no worker ever waits for the learner to begin the next."""
COLLECTED = 12
"""Units of which the real costs are taken, after as many that are not counted."""


def learner_for(env_id: str) -> Learner[AdversarialReward]:
    """Return a learner with the default settings."""
    gail = run_config(env_id, 1).imitation.gail
    demonstrations = random_demonstrations(EnvironmentConfig(id=env_id))
    spec, weights = environment_spec(env_id, {}), np.ones(len(demonstrations))
    return imitator(spec.observation_dim, spec.action_dim, spec.max_episode_steps, demonstrations, weights, gail, 0)


def real_costs(env_id: str) -> tuple[dict[str, float], Unit, UnitResult]:
    """Return processor seconds of a unit (collecting it, its share of an update), a unit, and its result."""
    learner = learner_for(env_id)
    gail = learner.config
    snapshots: list[Any] = [None] * gail.num_groups
    collecting, updating = [], []
    for iteration in range(2 * COLLECTED // gail.num_groups):
        results = []
        for group in range(gail.num_groups):
            unit = Unit(
                iteration=iteration,
                group=group,
                env_id=env_id,
                dynamics=(),
                num_simulators=gail.simulators_per_group,
                num_steps=gail.steps_per_rollout,
                policy_version=iteration,
                policy=learner.behavior_policy(),
                key=derive_key(0, "rollout", group, iteration),
                snapshot=snapshots[group],
            )
            started = time.process_time()
            result = collect(unit)
            collecting.append(time.process_time() - started)
            results.append(result)
            snapshots[group] = result.snapshot
        started = time.process_time()
        learner.update(TransitionBatch.of([result.rollout for result in results]), iteration)
        updating.append((time.process_time() - started) / gail.num_groups)
    costs = {
        "collect_s": statistics.median(collecting[-COLLECTED:]),
        "update_s": statistics.median(updating[-COLLECTED // gail.num_groups :]),
        "steps": gail.simulators_per_group * gail.steps_per_rollout,
        "unit_bytes": sum(map(len, encode(UnitMessage(Header("", "", "learner", 0), unit)))),
        "result_bytes": sum(map(len, encode(ResultMessage(Header("", "", "worker", 0), result)))),
    }
    return costs, unit, result


def answer_at_once(endpoint: str, names: list[str], result: UnitResult, is_over: Event) -> None:
    """Play several workers in one process."""
    dealers = [Dealer(endpoint, name) for name in names]
    for sequence, (name, dealer) in enumerate(zip(names, dealers, strict=True)):
        dealer.send(encode(Ready(Header("", "", name, sequence), collecting_versions())))
    while not is_over.is_set():
        for name, dealer in zip(names, dealers, strict=True):
            frames = dealer.receive(0.0005)
            if frames is None:
                continue
            message = decode(frames)
            assert isinstance(message, UnitMessage)
            asked = message.header
            answer = replace(result, iteration=message.unit.iteration, group=message.unit.group)
            dealer.send(encode(ResultMessage(Header(asked.run_id, asked.incarnation, name, asked.sequence), answer)))
    for dealer in dealers:
        dealer.close()


def intake(workers: int, unit: Unit, result: UnitResult, seconds: float) -> dict[str, float]:
    """Return units per second taken in from instant workers, and what each cost the learner's process."""
    context = multiprocessing.get_context("spawn")
    is_over = context.Event()
    with tempfile.TemporaryDirectory() as folder, private_endpoint(Path(folder)) as endpoint:
        rollouts = ZmqRollouts(endpoint, "intake", "first", unit_timeout_s=60.0)
        names = [f"instant-{i}" for i in range(workers)]
        process = context.Process(target=answer_at_once, args=(endpoint, names, result, is_over))
        process.start()
        units = [replace(unit, group=group, snapshot=result.snapshot) for group in range(workers * UNITS_PER_WORKER)]
        done = 0
        started = cpu = 0.0
        iteration = 0
        while not started or time.perf_counter() - started < seconds:
            if iteration == 3:
                started, cpu, done = time.perf_counter(), time.process_time(), 0
            iteration += 1
            rollouts.submit([replace(each, iteration=iteration) for each in units])
            done += len(rollouts.gather())
        wall_s, cpu_s = time.perf_counter() - started, time.process_time() - cpu
        is_over.set()
        process.join()
        rollouts.close()
    return {"workers": workers, "units_per_s": done / wall_s, "learner_s_per_unit": cpu_s / done}


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("--envs", nargs="+", default=["oodil/Hopper-v0", "oodil/HalfCheetah-v0"], metavar="ID")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 4, 16, 64, 256], help="instant workers")
    parser.add_argument("--seconds", type=float, default=5.0, help="time of each measurement")
    arguments = parser.parse_args()
    found = circumstances() | {"environments": {}}
    for env_id in arguments.envs:
        costs, unit, result = real_costs(env_id)
        rates = [intake(workers, unit, result, arguments.seconds) for workers in arguments.workers]
        busy_s = costs["update_s"] + min(rate["learner_s_per_unit"] for rate in rates)
        found["environments"][env_id] = {**costs, "intake": rates, "workers_at_saturation": costs["collect_s"] / busy_s}
        print(f"{env_id}: a unit of {costs['steps']} steps costs its worker {1e3 * costs['collect_s']:.1f} ms")
        size = costs["result_bytes"] / 1e3
        print(f"  and the learner's update {1e3 * costs['update_s']:.1f} ms; {size:.0f} kB come back")
        for rate in rates:
            megabytes = rate["units_per_s"] * (costs["unit_bytes"] + costs["result_bytes"]) / 1e6
            print(
                f"  {rate['workers']:4} instant workers: {rate['units_per_s']:7,.0f} units/s, {megabytes:6.0f} MB/s, "
                f"{1e3 * rate['learner_s_per_unit']:.2f} ms of the learner each"
            )
        print(f"  one learner is busy with {costs['collect_s'] / busy_s:.1f} such workers", flush=True)
    save(arguments.json, found)


if __name__ == "__main__":
    main()
