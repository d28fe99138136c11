"""The SHA-256 of every stage of the smoke run, by platform: ``python -m tests.pinned`` writes this machine's anew.

Results are the same bits under any worker count and after any kill, but not on every processor: matrix products and
tanh are rounded by the kernels that libraries choose, so what they chose is part of a platform's name.
"""

import json
import platform
import tempfile
from pathlib import Path

import numpy  # noqa: F401 (its BLAS is asked about below)
import threadpoolctl
import torch

import oodil
from oodil.pipeline.stages import stages
from oodil.pipeline.versions import library_versions

FILE = Path(__file__).with_name("pinned.json")
SMOKE = "smoke"


def platform_name() -> str:
    """Return what the bits of a result depend on, other than the code and the configuration."""
    # NumPy's own: other packages, which the tests load and no result depends on, bring further ones.
    libraries_loaded = threadpoolctl.threadpool_info()
    kernels = sorted(
        {str(each["architecture"]) for each in libraries_loaded if "numpy" in Path(each["filepath"]).parts[-2]}
    )
    chosen = [platform.system(), platform.machine(), torch.backends.cpu.get_cpu_capability(), *kernels]
    libraries = [f"{name} {version}" for name, version in library_versions().items() if name != "python"]
    return ", ".join([*chosen, *libraries])


def versions() -> dict[str, int]:
    """Return the version of each stage of the smoke run."""
    return {stage.name: stage.version for stage in stages(oodil.load_config(SMOKE))}


def hashes(results: oodil.RunResults) -> dict[str, str]:
    """Return the SHA-256 of each stage, all of which must be done."""
    described = results.describe()["stages"]
    assert {entry["state"] for entry in described.values()} == {"done"}, described
    return {name: entry["sha256"] for name, entry in described.items()}


def pinned() -> dict[str, dict[str, dict[str, int | str | None]]]:
    """Return what is held: by platform and stage, version and sha256; null until such a machine was at hand."""
    held: dict[str, dict[str, dict[str, int | str | None]]] = json.loads(FILE.read_text())
    return held


def main() -> None:
    """Run the smoke configuration and write this platform's hashes."""
    with tempfile.TemporaryDirectory() as folder:
        made = hashes(oodil.run(SMOKE, workers=2, run_dir=Path(folder) / "run"))
    held = pinned() if FILE.exists() else {}
    held[platform_name()] = {name: {"version": versions()[name], "sha256": sha256} for name, sha256 in made.items()}
    FILE.write_text(json.dumps(held, indent=2, sort_keys=True) + "\n")
    print(f"{FILE}: {platform_name()}")


if __name__ == "__main__":
    main()
