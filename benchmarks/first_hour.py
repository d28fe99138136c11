"""A newcomer's path, from nothing to a policy on a robot: minutes and size of each step.

A fresh virtual environment from the wheel; an environment class in a file beside the YAML, with actions in newtons and
observations in a dictionary; recordings of two labs in robomimic's format, states under nested keys; the run, its
verdict, a film, an ONNX model and its first action without oodil. Run ``python benchmarks/first_hour.py --json FILE``
in the environment of ``make install``: the newcomer gets the versions of ``constraints.txt`` and that environment's
build of PyTorch, which pip has to find (``PIP_EXTRA_INDEX_URL`` or ``PIP_FIND_LINKS``).
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from importlib.metadata import distributions, version
from pathlib import Path
from typing import Any

import h5py
from common import arguments_of, circumstances, save

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
NOT_BUILT = (".*", "build", "runs", "tables", "tests", "docs", "benchmarks", "__pycache__", "*.egg-info")
KEYS = "robot/base/place,robot/base/speed"
CONFIG = """\
name: cart
environment: {{id: cart:Cart-v0, dynamics: {{mass: 900.0}}}}
demonstrations: {{file: all.safetensors}}
clustering: {{num_clusters: 2}}
transferability: {{gail: {{total_steps: {steps}}}}}
imitation: {{gail: {{total_steps: {steps}}}}}
baselines: [naive_gail]
"""
ELSEWHERE = """\
import numpy, onnxruntime, sys
session = onnxruntime.InferenceSession("policy.onnx")
(actions,) = session.run(["action"], {"observation": numpy.array([[3.0, 0.0]], "float32")})
print(f"3 m from the middle: {actions[0, 0]:.0f} N; oodil loaded: {'oodil' in sys.modules}")
"""


def record(folder: Path) -> list[str]:
    """Write what the labs recorded into ``LAB.hdf5`` and return the names of the files."""
    sys.path.insert(0, str(EXAMPLES))
    from own_data import LABS, recordings

    for lab, mass in LABS.items():
        with h5py.File(folder / f"{lab.replace(' ', '-')}.hdf5", "w") as file:
            for n, states in enumerate(recordings(mass, 20)):
                base = file.create_group(f"data/demo_{n}/obs/robot/base")
                base["place"], base["speed"] = states[:, :1], states[:, 1:]
                file[f"data/demo_{n}"].attrs["num_samples"] = len(states)
    return [path.name for path in sorted(folder.glob("*.hdf5"))]


class Walk:
    """The steps so far, each a command in the newcomer's folder, with its minutes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.minutes: dict[str, float] = {}
        self._programs = folder / "venv" / "bin"
        # Nothing of the checkout, and nothing of whoever runs this, reaches the newcomer.
        hidden = ("PYTHONPATH", "VIRTUAL_ENV", "WANDB_MODE")
        self._environment = {name: value for name, value in os.environ.items() if name not in hidden}

    def step(self, name: str, *words: str) -> None:
        """Run a program of the virtual environment; what it prints is shown. Raises CalledProcessError if it fails."""
        print(f"\n## {name}: {' '.join(words[:2])} ...", flush=True)
        started = time.perf_counter()
        program = sys.executable if name == "venv" else str(self._programs / words[0])
        subprocess.run([program, *words[1:]], cwd=self.folder, env=self._environment, check=True)
        self.minutes[name] = self.minutes.get(name, 0.0) + (time.perf_counter() - started) / 60

    def installation(self) -> dict[str, int]:
        """Return MB (blocks on disk) and number of distributions of the virtual environment."""
        used = sum(path.lstat().st_blocks * 512 for path in (self.folder / "venv").rglob("*"))
        (site,) = (self.folder / "venv").glob("lib/python*/site-packages")
        return {"megabytes": round(used / 2**20), "distributions": len(list(distributions(path=[str(site)])))}


def walk(folder: Path, steps: int) -> dict[str, Any]:
    """Go the whole way in an empty folder and return the figures."""
    # Of a copy: setuptools leaves a folder behind where it builds, and takes what is in it the next time.
    source = shutil.copytree(ROOT, folder / "source", symlinks=True, ignore=shutil.ignore_patterns(*NOT_BUILT))
    wheel = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(source)]
    subprocess.run(wheel, check=True)
    (built,) = folder.glob("*.whl")
    shutil.copy(EXAMPLES / "cart.py", folder)
    (folder / "cart.yaml").write_text(CONFIG.format(steps=steps))
    files = record(folder)
    pip = ("python", "-m", "pip", "install", "--quiet", "--constraint", str(ROOT / "constraints.txt"))
    went = Walk(folder)
    went.step("venv", "python", "-m", "venv", "venv")
    # Of two builds of a version, pip would take one with CUDA where it knows no other index than PyPI.
    went.step("install", *pip, f"torch=={version('torch')}", str(built))
    core = went.installation()
    went.step("extras", *pip, f"{built}[data,onnx]", "onnxruntime")
    # `python -c` finds cart.py in the present folder; a conversion has no configuration that it could lie beside.
    convert = ("python", "-c", "from oodil.cli import main; main()", "demos", "convert", *files)
    went.step("convert", *convert, "--environment", "cart:Cart-v0", "--keys", KEYS, "--output", "all.safetensors")
    went.step("run", "oodil", "run", "cart.yaml", "--workers", "2")
    went.step("verdict", "oodil", "status", "runs/cart-seed0")
    went.step("film", "oodil", "evaluate", "runs/cart-seed0", "--video")
    went.step("onnx", "oodil", "export-policy", "runs/cart-seed0", "--onnx", "policy.onnx")
    went.step("elsewhere", "python", "-c", ELSEWHERE)
    return {"steps": steps, "minutes": went.minutes, "core": core, "with_extras": went.installation()}


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--steps", type=int, default=200_000, help="environment steps of each training")
    arguments = parser.parse_args()
    found = circumstances()
    with tempfile.TemporaryDirectory() as folder:
        found |= walk(Path(folder), arguments.steps)
    print()
    for name, minutes in found["minutes"].items():
        print(f"{name:10} {minutes:6.2f} min")
    print(f"{'together':10} {sum(found['minutes'].values()):6.2f} min")
    for name in ("core", "with_extras"):
        print(f"{name:12} {found[name]['megabytes']:,} MB, {found[name]['distributions']} distributions")
    save(arguments.json, found)


if __name__ == "__main__":
    main()
