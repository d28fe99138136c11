"""The libraries that a result was made with; written into every manifest."""

import platform
from importlib.metadata import PackageNotFoundError, version

_LIBRARIES = ("torch", "mujoco", "gymnasium", "numpy")
_COLLECTING = ("mujoco", "gymnasium", "numpy")


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
    return ", ".join(f"{name} {versions[name]}" for name in _COLLECTING)
