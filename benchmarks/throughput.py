"""How many environment steps per second, always beside what the machine could do at best.

Each figure is a ratio whose two sides alternate within one run, so that a busy machine slows both. Parts:

* stepping: a batch of simulators against bare ``mj_step`` on one core, through the same states, in processor time;
* learner: the whole GAIL loop against bare ``mj_step`` in one process per core, both at once;
* scaling: rollouts from two worker processes against those from one, for a learner that does nothing but take them in,
  so that each worker has a core to itself where there are two;
* imitation: the same loop with PPO against the `imitation` library (benchmarks/README.md says how to install it).

Run ``python benchmarks/throughput.py --rounds 2 --steps 200000 --json FILE``.
"""

import json
import multiprocessing
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from common import Quiet, arguments_of, circumstances, one_thread, run_config, save
from gymnasium.envs.mujoco import MujocoEnv
from numpy.typing import NDArray

from oodil.bench import learner_rate
from oodil.pipeline.algorithms.networks import PolicyNetwork
from oodil.pipeline.config import EnvironmentConfig, PpoConfig
from oodil.pipeline.data import Snapshot
from oodil.pipeline.environments import environment_spec, make_batch
from oodil.pipeline.environments.batch import STATE, MujocoBatch
from oodil.pipeline.training import experience
from oodil.workers import rollout_worker
from oodil.workers.channels import private_endpoint
from oodil.workers.supervisor import Supervisor
from oodil.workers.zmq_rollouts import ZmqRollouts

PARTS = ("stepping", "learner", "scaling")
ENVIRONMENTS = ("oodil/Hopper-v0", "oodil/Walker2d-v0", "oodil/HalfCheetah-v0")
SIMULATORS = 16
STEPS_PER_ROUND = 50
RAW_SECONDS = 3.0
SCALING_STEPS = 4_000
"""Of each simulator."""
IMITATION_BATCH, IMITATION_EPOCHS, IMITATION_MINIBATCH = 2560, 5, 512
IMITATION_LOOP = Path(__file__).resolve().parent / "peers" / "imitation_gail.py"
IMITATION_SETUP = """\
  python3.11 -m venv imitation-venv
  imitation-venv/bin/pip install imitation==1.0.1 'gymnasium[mujoco]==0.29.1' 'mujoco<3' 'setuptools<81'
  python benchmarks/throughput.py --imitation-python imitation-venv/bin/python"""


@contextmanager
def clock_as_shipped() -> Iterator[None]:
    """Let MuJoCo time itself, as it does unless `make_batch` stops its clock."""
    stopped = mujoco.get_mjcb_time()
    mujoco.set_mjcb_time(None)
    mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))  # where there is no clock, a new simulator brings one
    try:
        yield
    finally:
        mujoco.set_mjcb_time(stopped)


class RawPhysics:
    """Simulators of one model that are stepped by ``mj_step`` and by nothing else.

    ``as_shipped``: with Gymnasium's model and MuJoCo's clock as they come. Otherwise with those of `LocomotionBatch`.
    """

    def __init__(self, env_id: str, as_shipped: bool = True) -> None:
        task, batch = gymnasium.make(env_id).unwrapped, make_batch(env_id, {}, 1)
        assert isinstance(task, MujocoEnv) and isinstance(batch, MujocoBatch)
        self._frame_skip = task.frame_skip
        self._model: mujoco.MjModel = task.model if as_shipped else batch.model
        self._as_shipped = as_shipped
        self._data = [mujoco.MjData(self._model) for _ in range(SIMULATORS)]
        self._controls = [data.ctrl for data in self._data]

    def restore(self, snapshot: Snapshot) -> None:
        """Put every simulator where the snapshot says."""
        for data, state in zip(self._data, snapshot.states, strict=True):
            mujoco.mj_setState(self._model, data, state, STATE)

    def play(self, actions: NDArray[np.float32]) -> float:
        """Apply (T, G, A) actions and return the seconds of computation it took."""
        model, frame_skip, step = self._model, self._frame_skip, mujoco.mj_step
        with clock_as_shipped() if self._as_shipped else nullcontext():
            started = time.process_time()
            for action in actions:
                for data, control, row in zip(self._data, self._controls, action, strict=True):
                    control[:] = row
                    step(model, data, frame_skip)
            return time.process_time() - started

    def states(self) -> NDArray[np.float64]:
        """Return (G, ...) integration states."""
        states = np.empty((SIMULATORS, mujoco.mj_stateSize(self._model, STATE)))
        for data, row in zip(self._data, states, strict=True):
            mujoco.mj_getState(self._model, data, row, STATE)
        return states


def draw_actions(rng: np.random.Generator, action_dim: int) -> NDArray[np.float32]:
    """Return (T, G, A) actions of one round: mild ones, under which a robot stays up for a while."""
    return rng.uniform(-0.5, 0.5, (STEPS_PER_ROUND, SIMULATORS, action_dim)).astype(np.float32)


def stepping(env_id: str, rounds: int) -> dict[str, Any]:
    """Compare `LocomotionBatch` with bare physics on one core. Raises AssertionError if their states come apart."""
    batch = make_batch(env_id, {}, SIMULATORS)
    shipped, lean = RawPhysics(env_id), RawPhysics(env_id, as_shipped=False)
    rng = np.random.default_rng(0)

    def play_batch(actions: NDArray[np.float32]) -> float:
        started = time.process_time()
        for action in actions:
            batch.step(action)
            batch.observations()
        return time.process_time() - started

    sides = {"batch": play_batch, "raw": shipped.play, "lean_raw": lean.play}
    rates: dict[str, list[float]] = {side: [] for side in sides}
    for index in range(rounds):
        for g in range(SIMULATORS):
            batch.reset(g, seed=index * SIMULATORS + g)
        for raw in (shipped, lean):
            raw.restore(batch.snapshot())
        actions = draw_actions(rng, batch.action_dim)
        for side in (*list(sides)[index % 3 :], *list(sides)[: index % 3]):  # each is first, second and last in turn
            rates[side].append(actions.shape[0] * SIMULATORS / sides[side](actions))
        for raw in (shipped, lean):
            assert batch.snapshot().states.tobytes() == raw.states().tobytes()
    return {
        **{f"{side}_steps_per_s": statistics.median(values) for side, values in rates.items()},
        "ratio": statistics.median(b / r for b, r in zip(rates["batch"], rates["raw"], strict=True)),
        "ratio_lean": statistics.median(b / r for b, r in zip(rates["batch"], rates["lean_raw"], strict=True)),
        "rounds": rounds,
    }


def raw_rate(env_id: str) -> float:
    """Return the steps per second of bare physics in this process, by the clock on the wall."""
    batch, raw = make_batch(env_id, {}, SIMULATORS), RawPhysics(env_id)
    rng = np.random.default_rng(0)
    seconds, steps = 0.0, 0
    while seconds < RAW_SECONDS:
        for g in range(SIMULATORS):
            batch.reset(g, seed=steps + g)
        raw.restore(batch.snapshot())
        actions = draw_actions(rng, batch.action_dim)
        started = time.perf_counter()
        raw.play(actions)
        seconds += time.perf_counter() - started
        steps += STEPS_PER_ROUND * SIMULATORS
    return steps / seconds


def learner(env_id: str, workers: int, total_steps: int, rounds: int, cores: int) -> dict[str, Any]:
    """Compare the learner loop with bare physics on ``cores`` cores at once."""
    config = run_config(env_id, total_steps)
    loop, raw = [], []
    with multiprocessing.get_context("spawn").Pool(cores) as pool:
        pool.map(raw_rate, [env_id] * cores, chunksize=1)
        for _ in range(rounds):
            loop.append(learner_rate(config, workers))
            raw.append(sum(pool.map(raw_rate, [env_id] * cores, chunksize=1)))
    return {
        "workers": workers,
        "raw_cores": cores,
        "loop_steps_per_s": statistics.median(rate["steps_per_s"] for rate in loop),
        "raw_steps_per_s": statistics.median(raw),
        "ratio": statistics.median(rate["steps_per_s"] / r for rate, r in zip(loop, raw, strict=True)),
        "episode_length": loop[-1]["episode_length"],
        "rounds": rounds,
        "total_steps": total_steps,
        "gail": config.imitation.gail.model_dump(mode="json"),
    }


def rollout_rate(env_id: str, workers: int) -> float:
    """Return the steps per second that workers collect while nobody learns."""
    config = run_config(env_id, 1).imitation.gail
    spec = environment_spec(env_id, {})
    network = PolicyNetwork(spec.observation_dim, spec.action_dim, config.policy_hidden, torch.Generator())
    environment, policy = EnvironmentConfig(id=env_id), network.export()
    with tempfile.TemporaryDirectory() as folder, private_endpoint(Path(folder)) as endpoint:
        rollouts = ZmqRollouts(endpoint, "scaling", "first", unit_timeout_s=60.0)
        context = Quiet(rollouts)
        with Supervisor(Path(folder), "scaling") as supervisor:
            for index in range(workers):
                shared = {"endpoint": endpoint, "run_id": "scaling"}
                supervisor.start(f"worker-{index}", rollout_worker.main, shared)
            supervisor.poll(0.0)
            experience(policy, environment, config, SCALING_STEPS // 4, 0, context)  # processes start
            started = time.perf_counter()
            collected = experience(policy, environment, config, SCALING_STEPS, 1, context)
            seconds = time.perf_counter() - started
        rollouts.close()
    return len(collected) / seconds


def scaling(env_id: str, rounds: int) -> dict[str, Any]:
    """Compare two rollout workers with one."""
    one, two = [], []
    for _ in range(rounds):
        one.append(rollout_rate(env_id, 1))
        two.append(rollout_rate(env_id, 2))
    return {
        "one_worker_steps_per_s": statistics.median(one),
        "two_workers_steps_per_s": statistics.median(two),
        "ratio": statistics.median(b / a for a, b in zip(one, two, strict=True)),
        "rounds": rounds,
    }


def imitation(python: str, total_steps: int, rounds: int, workers: int) -> dict[str, Any]:
    """Compare with the `imitation` library: GAIL, PPO, the same networks, batch, epochs and minibatches.

    Beside it the loop as it is by default, whose networks and batch are the same, too, with TRPO.
    """
    policy_optimizer = PpoConfig(epochs=IMITATION_EPOCHS, minibatch_size=IMITATION_MINIBATCH, learning_rate=3e-4)
    default = run_config("oodil/Hopper-v0", total_steps)
    assert default.imitation.gail.steps_per_iteration == IMITATION_BATCH
    config = run_config(
        "oodil/Hopper-v0",
        total_steps,
        policy_optimizer=policy_optimizer.model_dump(),
        value={"epochs": IMITATION_EPOCHS, "minibatch_size": IMITATION_MINIBATCH},
    )
    peer_steps = total_steps // 4
    command = [python, str(IMITATION_LOOP)]
    command += [str(value) for value in (peer_steps, IMITATION_BATCH, IMITATION_EPOCHS, IMITATION_MINIBATCH)]
    theirs, inline, distributed, by_default = [], [], [], []
    peer: dict[str, Any] = {}
    for _ in range(rounds):
        inline.append(learner_rate(config, 0)["steps_per_s"])
        distributed.append(learner_rate(config, workers)["steps_per_s"])
        by_default.append(learner_rate(default, workers)["steps_per_s"])
        answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        peer = json.loads(answer.splitlines()[-1])
        theirs.append(peer["steps_per_s"])
    return {
        "imitation_steps_per_s": statistics.median(theirs),
        "inline_steps_per_s": statistics.median(inline),
        "workers_steps_per_s": statistics.median(distributed),
        "ratio_inline": statistics.median(a / b for a, b in zip(inline, theirs, strict=True)),
        "ratio_workers": statistics.median(a / b for a, b in zip(distributed, theirs, strict=True)),
        "default_steps_per_s": statistics.median(by_default),
        "ratio_default": statistics.median(a / b for a, b in zip(by_default, theirs, strict=True)),
        "workers": workers,
        "rounds": rounds,
        "imitation_versions": peer["versions"],
        "gail": config.imitation.gail.model_dump(mode="json"),
    }


def main() -> None:
    one_thread()
    parser = arguments_of(__doc__)
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--envs", nargs="+", choices=ENVIRONMENTS, default=ENVIRONMENTS, metavar="ID")
    parser.add_argument(
        "--rounds", type=int, default=3, help="rounds of the long parts; stepping makes 20 times as many"
    )
    parser.add_argument("--steps", type=int, default=300_000, help="environment steps of each learner run")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 2], help="worker counts of the learner part")
    parser.add_argument("--imitation-python", help="interpreter of an environment with `imitation`; adds that part")
    arguments = parser.parse_args()
    cores = min(2, os.cpu_count() or 1)
    result = circumstances()
    if "stepping" in arguments.parts:
        result["stepping"] = {}
        for env_id in arguments.envs:
            figures = result["stepping"][env_id] = stepping(env_id, 20 * arguments.rounds)
            print(
                f"stepping  {env_id:22} {figures['batch_steps_per_s']:9,.0f} /s of "
                f"{figures['raw_steps_per_s']:9,.0f} raw: {figures['ratio']:.3f}; "
                f"of raw with our settings: {figures['ratio_lean']:.3f}",
                flush=True,
            )
    if "learner" in arguments.parts:
        result["learner"] = {}
        for env_id in arguments.envs:
            result["learner"][env_id] = []
            for workers in arguments.workers:
                figures = learner(env_id, workers, arguments.steps, arguments.rounds, cores)
                result["learner"][env_id].append(figures)
                print(
                    f"learner   {env_id:22} {figures['loop_steps_per_s']:9,.0f} /s of "
                    f"{figures['raw_steps_per_s']:9,.0f} raw on {cores} cores: {figures['ratio']:.3f} "
                    f"({workers} workers)",
                    flush=True,
                )
    if "scaling" in arguments.parts:
        result["scaling"] = {}
        for env_id in arguments.envs:
            figures = result["scaling"][env_id] = scaling(env_id, arguments.rounds)
            print(
                f"scaling   {env_id:22} {figures['two_workers_steps_per_s']:9,.0f} /s with two workers, "
                f"{figures['one_worker_steps_per_s']:9,.0f} with one: {figures['ratio']:.2f}",
                flush=True,
            )
    if arguments.imitation_python:
        figures = imitation(arguments.imitation_python, arguments.steps, arguments.rounds, workers=2)
        result["imitation"] = figures
        print(
            f"imitation {figures['imitation_steps_per_s']:,.0f} /s; inline {figures['inline_steps_per_s']:,.0f} "
            f"({figures['ratio_inline']:.1f} times), 2 workers {figures['workers_steps_per_s']:,.0f} "
            f"({figures['ratio_workers']:.1f} times); by default, with TRPO, {figures['default_steps_per_s']:,.0f} "
            f"({figures['ratio_default']:.1f} times)",
            flush=True,
        )
    else:
        print(f"imitation not measured; to measure it:\n{IMITATION_SETUP}")
    save(arguments.json, result)


if __name__ == "__main__":
    main()
