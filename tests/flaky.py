"""Pendulums that misbehave, as told by files: each file is one misdeed, done once."""

import os
import random
import signal
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.classic_control.pendulum import PendulumEnv

FOLDER_VARIABLE = "OODIL_TEST_MISDEEDS"
MISDEEDS = ("raises", "segfault", "exits", "stalls", "nan")
CHANCE = 1 / 100
"""Of doing the next misdeed in a step."""


def allow(folder: Path, number: int) -> None:
    """Let every misdeed be done once more."""
    for misdeed in MISDEEDS:
        (folder / f"{misdeed}.{number}").touch()


class FlakyPendulum(PendulumEnv):
    """Pendulum-v1 with misdeeds now and then, not drawn from its seed; none in the leader of a session, a `LiveRun`."""

    def step(self, u: Any) -> Any:
        misdeed = self._misdeed()
        if misdeed == "raises":
            raise RuntimeError("the simulator says no")
        if misdeed == "segfault":
            os.kill(os.getpid(), signal.SIGSEGV)
        if misdeed == "exits":
            os._exit(3)
        if misdeed == "stalls":
            time.sleep(3600)
        outcome = super().step(u)
        return (np.full(3, np.nan, np.float32), *outcome[1:]) if misdeed == "nan" else outcome

    def _misdeed(self) -> str:
        if random.SystemRandom().random() > CHANCE or os.getsid(0) == os.getpid():
            return ""
        for file in sorted(Path(os.environ[FOLDER_VARIABLE]).iterdir()):
            try:
                file.unlink()
            except FileNotFoundError:
                continue
            return file.stem
        return ""


class StallingPendulum(PendulumEnv):
    """Pendulum-v1 that stalls in its first step while the file ``stalls`` is there."""

    def step(self, u: Any) -> Any:
        try:
            (Path(os.environ[FOLDER_VARIABLE]) / "stalls").unlink()
        except FileNotFoundError:
            return super().step(u)
        time.sleep(3600)


gymnasium.register("StallingPendulum-v0", entry_point=StallingPendulum, max_episode_steps=200)
gymnasium.register("FlakyPendulum-v0", entry_point=FlakyPendulum, max_episode_steps=200)
