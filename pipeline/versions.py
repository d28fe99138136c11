"""The libraries that a result was made with; written into every manifest."""

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_LIBRARIES = ("torch", "mujoco", "gymnasium", "numpy")
_COLLECTING = ("mujoco", "gymnasium", "numpy")
_OUR_COLLECTING = ("environments/*.py", "collecting.py", "policy.py", "seeding.py")
"""Beside this file, the code that a rollout is computed by."""


def library_versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that shape results, without importing any of them."""
    versions = {"python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def collecting_versions() -> str:
    """Return what the bits of a rollout depend on; a learner takes none from a worker that has others."""
    versions = library_versions()
    code = hashlib.sha256()
    for pattern in _OUR_COLLECTING:
        for path in sorted(Path(__file__).parent.glob(pattern)):
            code.update(path.read_bytes())
    return ", ".join([*(f"{name} {versions[name]}" for name in _COLLECTING), f"oodil's code {code.hexdigest()[:8]}"])
