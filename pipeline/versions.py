"""The libraries that a result was made with; written into every manifest."""

import platform
from importlib.metadata import PackageNotFoundError, version

_LIBRARIES = ("torch", "mujoco", "gymnasium", "numpy")


def library_versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that shape results, without importing any of them."""
    versions = {"python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions
