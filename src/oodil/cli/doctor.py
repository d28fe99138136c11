"""The command that looks at a machine: what is there, how fast it is, and what to do about what is missing."""

import json
import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any

import typer

PYTHONS = (3, 11), (3, 13)
"""The oldest and the newest version that is tested."""
FREE_GB = 2.0
"""What a long run and its report may take."""
EXTRAS = {
    "data": ("minari", "h5py", "pyarrow"),
    "driving": ("highway-env",),
    "onnx": ("onnx",),
    "ray": ("ray",),
    "robot": ("robosuite",),
    "tensorboard": ("tensorboard",),
}
"""Packages that parts of the program need, by the extra that brings them."""


@dataclass(frozen=True)
class Finding:
    """One line of what was found."""

    name: str
    found: str
    advice: str = ""
    """What to do; empty if all is well."""

    @property
    def state(self) -> str:
        """Whether somebody should look at it."""
        return "attention" if self.advice else "ok"


def doctor(as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False) -> None:
    """Look at this machine: versions, speed, rendering, Ray, disk; each line is ok or says what to do."""
    findings = []
    for look in LOOKS:
        for finding in _seen(look):
            findings.append(finding)
            if not as_json:
                print(f"{finding.state:<10} {finding.name:<12} {finding.found}")
                if finding.advice:
                    print(f"{'':<23} -> {finding.advice}", flush=True)
    if as_json:
        print(json.dumps({each.name: {"state": each.state} | asdict(each) for each in findings}, indent=2))


def _seen(look: "Look") -> Iterator[Finding]:
    """Yield what is found; a machine on which one thing is broken is told the others, too."""
    try:
        yield from look()
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        yield Finding(look.__name__.removeprefix("_"), f"{type(error).__name__}: {reason}", "mend this first")


def _versions() -> Iterator[Finding]:
    (low, high), found = PYTHONS, sys.version_info[:2]
    named = f"oodil {_version('oodil')}, Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    wrong = f"tested with Python {low[0]}.{low[1]} to {high[0]}.{high[1]}; make an environment with one of these"
    yield Finding("version", named, "" if low <= found <= high else wrong)
    from oodil.pipeline.versions import library_versions

    libraries = {name: number for name, number in library_versions().items() if name != "python"}
    missing = [name for name, number in libraries.items() if number == "not installed"]
    named = ", ".join(f"{name} {number}" for name, number in libraries.items())
    yield Finding("libraries", named, f"pip install {' '.join(missing)}" if missing else "")
    lacking = [extra for extra, packages in EXTRAS.items() if any(_version(each) is None for each in packages)]
    there = ", ".join(f"{each} {_version(each)}" for names in EXTRAS.values() for each in names if _version(each))
    later = f"; not installed, if you need it: pip install 'oodil[{','.join(lacking)}]'" if lacking else ""
    yield Finding("extras", (there or "none") + later)


def _threads() -> Iterator[Finding]:
    import torch

    from oodil.bench import usable_cores

    cores, load = usable_cores(), os.getloadavg()[0]
    busy = f"other programs compute here ({load:.1f} at a time): runs take longer than announced"
    yield Finding("cores", f"{cores} usable of {os.cpu_count()}, load {load:.1f}", busy if load > 0.5 * cores else "")
    threads = torch.get_num_threads()
    wrong = "results depend on it; start oodil by its own command, which sets it to 1"
    yield Finding("threads", f"{threads} in each process", wrong if threads != 1 else "")
    there = ", though there is one" if torch.cuda.is_available() else ""
    yield Finding("GPU", f"not used{there}: networks are small, and simulators run on the processor")


def _rate() -> Iterator[Finding]:
    from oodil.estimate import REFERENCE_STEPS_PER_S, hopper_seconds

    rate = 1 / hopper_seconds()
    found = f"{rate:,.0f} steps/s of Hopper on one core; a fast machine takes {REFERENCE_STEPS_PER_S:,}"
    slow = f"runs take about {REFERENCE_STEPS_PER_S / rate:.1f} times as long as there"
    yield Finding("simulator", found, slow if rate < REFERENCE_STEPS_PER_S / 2 else "")


def _ray() -> Iterator[Finding]:
    address = os.environ.get("RAY_ADDRESS")
    number = _version("ray")
    found = f"{number}, installed" if number else "not installed; only --engine ray needs it"
    told = f"{found}; RAY_ADDRESS is {address}" if address else found
    yield Finding("Ray", told, "pip install 'oodil[ray]'" if address and not number else "")


def _disk() -> Iterator[Finding]:
    here = Path.cwd()
    free = shutil.disk_usage(here).free / 1e9
    found = f"{free:,.1f} GB free in {here}"
    if not os.access(here, os.W_OK):
        yield Finding("disk", f"{found}, which is read-only", "work in a folder of your own, or use --run-dir")
    else:
        yield Finding("disk", found, "make room, or use --run-dir on another disk" if free < FREE_GB else "")


def _rendering() -> Iterator[Finding]:
    """Make a picture; it comes last, because a broken driver may end the process."""
    from oodil.pipeline.environments.pictures import choose_backend

    choose_backend()
    backend = os.environ.get("MUJOCO_GL", "glfw")
    advice = "only films need it; apt-get install libegl1, or libosmesa6 and MUJOCO_GL=osmesa"
    try:
        import gymnasium

        env: gymnasium.Env[Any, Any] = gymnasium.make("oodil/Hopper-v0", render_mode="rgb_array")
        env.reset(seed=0)
        env.render()
        env.close()
    except Exception as error:  # Whatever a driver raises is what is to be found here.
        yield Finding("rendering", f"{backend} makes no picture: {error!r}"[:160], advice)
    else:
        yield Finding("rendering", f"{backend} makes pictures")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


Look = Callable[[], Iterator[Finding]]
LOOKS: tuple[Look, ...] = (_versions, _threads, _rate, _ray, _disk, _rendering)
