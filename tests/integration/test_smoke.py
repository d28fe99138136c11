"""The smoke configuration from the checkout and from an installed wheel: the same bits, and those of before."""

import os
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

import oodil
from tests import pinned
from tests.runs import ROOT

pytestmark = pytest.mark.timeout(900)
DECOYS = ("pipeline", "workers", "walk", "bench", "terminal", "orchestrator", "cli", "configs")
"""Modules that a user may well have, and that oodil must never take for its own."""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> oodil.RunResults:
    """The smoke run of this checkout."""
    return oodil.run(pinned.SMOKE, workers=2, run_dir=tmp_path_factory.mktemp("smoke") / "run")


def test_code_that_changes_bits_comes_with_a_raised_version(checkout: oodil.RunResults) -> None:
    held = pinned.pinned().get(pinned.platform_name())
    if held is None:
        pytest.skip(f"no hashes for {pinned.platform_name()}; `python -m tests.pinned` adds this machine's")
    versions, made = pinned.versions(), pinned.hashes(checkout)
    assert held.keys() == made.keys(), "the smoke run has other stages; `python -m tests.pinned` writes its hashes"
    unknown = [stage for stage in made if held[stage]["sha256"] is None]
    for stage, sha256 in made.items():
        if stage in unknown:
            continue
        if held[stage]["version"] == versions[stage]:
            assert held[stage]["sha256"] == sha256, (
                f"{stage} gives other bits under the same version {versions[stage]}: artifacts of older code would be "
                "reused beside new ones. If the change is meant, raise the stage's version (and that of no other: what "
                "follows from it is recomputed by its input) and run `python -m tests.pinned`; otherwise mend the code"
            )
        else:
            assert held[stage]["sha256"] == sha256, f"{stage} has a new version; run `python -m tests.pinned`"
    if unknown:
        pytest.skip(f"no hashes of {', '.join(unknown)}; `python -m tests.pinned` adds this machine's")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel, built from a copy of what is tracked."""
    source = tmp_path_factory.mktemp("source") / "oodil"
    kept = ("pyproject.toml", "README.md", "LICENSE", "src", "pipeline", "workers", "configs", "orchestrator.py")
    source.mkdir()
    for name in kept:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, source / name)
    target = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--wheel-dir", str(target), str(source)], check=True)
    (built,) = target.glob("*.whl")
    return built


def test_a_wheel_holds_oodil_alone(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"oodil"}
    for needed in ("py.typed", "configs/hopper.yaml", "configs/experts/hopper-gravity-9.8/policy.safetensors"):
        assert f"oodil/{needed}" in names
    listing = ["git", "ls-files", "pipeline", "workers"]
    tracked = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    assert "pipeline/stage.py" in tracked
    missing = [name for name in tracked if f"oodil/{name}" not in names]
    assert not missing, missing


def test_an_installed_wheel_gives_the_same_bits_beside_modules_of_the_same_names(
    wheel: Path, checkout: oodil.RunResults, tmp_path: Path
) -> None:
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    zipfile.ZipFile(wheel).extractall(site)
    # What oodil depends on is taken from here; an editable install there is a .pth file, which is read in `site` alone.
    (here,) = {Path(path) for path in sys.path if path.endswith("site-packages")}
    (site / "dependencies.pth").write_text(f"{here}\n")
    work = tmp_path / "work"
    work.mkdir()
    for name in DECOYS:
        (work / f"{name}.py").write_text(f"raise ImportError('the user\\'s own {name}.py')\n")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PYTHONPATH"] = str(work)

    def command(*words: str) -> str:
        done = subprocess.run(words, cwd=work, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, (words, done.stdout, done.stderr)
        return done.stdout

    program = "import oodil, sys; print(oodil.__file__); from oodil.cli import main; sys.argv[0] = 'oodil'; "
    found = command(str(python), "-c", "import oodil; print(oodil.__file__)").strip()
    assert Path(found).is_relative_to(tmp_path), found
    command(str(python), "-c", program + "main()", "run", "smoke", "--workers", "2")
    assert pinned.hashes(oodil.open_run(work / "runs" / "smoke-seed0")) == pinned.hashes(checkout)
