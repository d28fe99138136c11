"""The run directory: artifacts, checkpoints, manifests. No other file knows how they lie on disk.

An artifact is a folder that is finished if and only if its ``manifest.json`` exists. The folder is written under a
temporary name, flushed to disk and renamed, so it is there as a whole or not at all; the manifest lists every file with
its SHA-256, and reading checks it. Checkpoints are artifacts too, so they are protected in the same way.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from oodil.pipeline.errors import DamagedArtifactError, DataError, StorageError

MANIFEST = "manifest.json"
RESULTS, MADE = "results.json", "made.json"
"""What an experiment leaves in its folder: what was found, and how it was made."""
KEPT_CHECKPOINTS = 2

Value = TypeVar("Value")
Files = dict[str, bytes]
"""Contents of an artifact by file name."""


def encode_arrays(arrays: dict[str, NDArray]) -> bytes:
    """Return a safetensors file with the given arrays."""
    # Not ascontiguousarray, which turns a scalar into an array of one.
    return safetensors.numpy.save({name: np.asarray(value, order="C") for name, value in arrays.items()})


def nested(prefix: str, values: Mapping[str, Value]) -> dict[str, Value]:
    """Return arrays or tensors under names that begin with ``prefix/``, to be kept with others; see `below`."""
    return {f"{prefix}/{name}": value for name, value in values.items()}


def below(prefix: str, values: Mapping[str, Value]) -> dict[str, Value]:
    """Return what `nested` put under a prefix, by its own names."""
    start = f"{prefix}/"
    return {name.removeprefix(start): value for name, value in values.items() if name.startswith(start)}


def encode_json(value: Any, sort_keys: bool = True) -> bytes:
    """Return readable JSON, keys sorted or in their order; numbers that are not finite become null."""
    return (json.dumps(_finite(value), indent=2, sort_keys=sort_keys, allow_nan=False) + "\n").encode()


def read_json(path: Path, kind: type[Value]) -> Value:
    """Return what a file holds, of a kind. Raises DataError for one that cannot be read or holds another."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:
        raise DataError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(value, kind):
        raise DataError(f"{path}: expected a {kind.__name__}, found a {type(value).__name__}")
    return value


def read_made(folder: Path) -> list[dict[str, Any]]:
    """Return how an experiment was made: what is known of each command; nothing if the file is not there.

    Raises DataError for a file that is not as described.
    """
    path = folder / MADE
    made = read_json(path, list) if path.is_file() else []
    if not all(map(_tells_a_command, made)):
        raise DataError(
            f"{path}: every entry needs the seconds of each run; a command is a list of words, a machine an object"
        )
    return made


def _tells_a_command(entry: Any) -> bool:
    return (
        isinstance(entry, dict)
        and isinstance(command := entry.get("command", []), list)
        and all(isinstance(word, str) for word in command)
        and isinstance(entry.get("machine", {}), dict)
        and isinstance(entry.get("seconds"), dict)
        and all(isinstance(seconds, int | float) for seconds in entry["seconds"].values())
    )


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def fingerprint(value: Any) -> str:
    """Return the SHA-256 of a JSON value in canonical form."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


@dataclass(frozen=True)
class Artifact:
    """A finished folder and what its manifest says."""

    path: Path
    fingerprint: str
    """Names what it was made from."""
    origin: dict[str, Any]
    """The settings and inputs behind the fingerprint, readable, so that a difference can be named."""
    versions: dict[str, str]
    """Of the libraries that made it."""
    hashes: dict[str, str]
    """SHA-256 of each file."""

    @property
    def sha256(self) -> str:
        """One hash over the hashes of all files: equal content, equal hash."""
        return fingerprint(self.hashes)

    def made_from(self, origin: dict[str, Any]) -> bool:
        """Return whether it was made from exactly this origin."""
        return self.fingerprint == fingerprint(origin)

    def read(self, name: str) -> bytes:
        """Return the bytes of a file. Raises DamagedArtifactError unless they are those that were written."""
        path = self.path / name
        try:
            content = path.read_bytes()
        except OSError as error:
            raise DamagedArtifactError(f"{path}: {error.strerror}") from error
        if hashlib.sha256(content).hexdigest() != self.hashes.get(name):
            raise DamagedArtifactError(f"{path}: the content does not have the SHA-256 of the manifest")
        return content

    def arrays(self, name: str) -> dict[str, NDArray]:
        """Return the arrays of a safetensors file, checked."""
        return safetensors.numpy.load(self.read(name))

    def json(self, name: str) -> Any:
        """Return the value of a JSON file, checked."""
        return json.loads(self.read(name))

    def files(self) -> Files:
        """Return the whole content, checked."""
        return {name: self.read(name) for name in self.hashes}

    def verify(self) -> None:
        """Read every file. Raises DamagedArtifactError for the first that is not as written."""
        for name in self.hashes:
            self.read(name)


def write_artifact(
    path: Path, origin: dict[str, Any], files: Files, versions: dict[str, str] | None = None
) -> Artifact:
    """Write a finished artifact at ``path`` atomically, replacing any other there.

    Raises StorageError when the disk does not take it; an existing artifact is then left unchanged.
    """
    try:
        _write_folder(path, _with_manifest(origin, files, versions or {}))
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror or error}") from error
    written = read_artifact(path)
    assert written is not None
    return written


def _with_manifest(origin: dict[str, Any], files: Files, versions: dict[str, str]) -> Files:
    """Return the files and, last, the manifest that lists them."""
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in sorted(files.items())}
    manifest = {"fingerprint": fingerprint(origin), "origin": origin, "versions": versions, "files": hashes}
    return files | {MANIFEST: encode_json(manifest)}


def _write_folder(path: Path, files: Files) -> None:
    """Write a folder under a temporary name, flush it and put it in the place of ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f".{path.name}.new"
    replaced = path.parent / f".{path.name}.old"
    try:
        _remove(temporary)
        temporary.mkdir()
        for name, content in files.items():
            with open(temporary / name, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        _sync_folder(temporary)
        _remove(replaced)
        if path.exists():
            path.rename(replaced)
        temporary.rename(path)
        _sync_folder(path.parent)
    finally:
        _remove(temporary)
        if replaced.exists() and not path.exists():
            replaced.rename(path)
    _remove(replaced)


def write_file(path: Path, content: bytes) -> None:
    """Replace one file atomically; for files of a run that are no artifact. Raises StorageError."""
    temporary = path.with_name(f".{path.name}.new")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror or error}") from error


def read_artifact(path: Path) -> Artifact | None:
    """Return the artifact at ``path``, or None unless it is finished.

    Raises DamagedArtifactError for a bad manifest.
    """
    if not (path / MANIFEST).is_file():
        return None
    try:
        manifest = json.loads((path / MANIFEST).read_bytes())
        return Artifact(path, manifest["fingerprint"], manifest["origin"], manifest["versions"], manifest["files"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DamagedArtifactError(f"{path / MANIFEST}: not a manifest ({error})") from error


def finished(path: Path, origin: dict[str, Any]) -> Artifact | None:
    """Return the artifact at ``path`` if it is of this origin and undamaged."""
    try:
        artifact = read_artifact(path)
        if artifact is None or not artifact.made_from(origin):
            return None
        artifact.verify()
    except DamagedArtifactError:
        return None
    return artifact


def remove_artifact(path: Path) -> None:
    """Delete an artifact; its manifest goes first, so that half a deletion is no artifact. Raises StorageError."""
    try:
        (path / MANIFEST).unlink(missing_ok=True)
        _remove(path)
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror or error}") from error


def _remove(path: Path) -> None:
    if path.exists():
        shutil.rmtree(path)


def _sync_folder(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class Checkpoints:
    """The newest states of one job, in a folder of its own; the last two are kept."""

    def __init__(self, folder: Path, origin: dict[str, Any]) -> None:
        self.folder = folder
        self.origin = origin

    def save(self, step: int, arrays: dict[str, NDArray]) -> None:
        """Write a checkpoint, keep the one before, and drop the others.

        Among those dropped are all of another origin and all of a later step: a job that started anew, or from an
        earlier checkpoint than the newest, would otherwise see its own pushed out by what it left behind.
        """
        newest = write_artifact(self.folder / f"{step:09d}", self.origin, {"state.safetensors": encode_arrays(arrays)})
        own = [path for path in self._paths() if path.name <= newest.path.name and self._is_own(path)]
        for path in self._paths():
            if path not in own[-KEPT_CHECKPOINTS:]:
                remove_artifact(path)

    def load(self) -> tuple[dict[str, NDArray] | None, list[str]]:
        """Return the newest sound state of a job with this origin, or None, and a warning for each damaged one."""
        warnings: list[str] = []
        for path in reversed(self._paths()):
            try:
                checkpoint = read_artifact(path)
                if checkpoint is not None and checkpoint.made_from(self.origin):
                    return checkpoint.arrays("state.safetensors"), warnings
            except (DamagedArtifactError, safetensors.SafetensorError) as error:
                warnings.append(f"checkpoint ignored: {error}")
        return None, warnings

    def exist(self) -> bool:
        """Return whether there is anything to resume from."""
        return self.load()[0] is not None

    def clear(self) -> None:
        """Delete all checkpoints: the job is finished."""
        _remove(self.folder)

    def _is_own(self, path: Path) -> bool:
        try:
            checkpoint = read_artifact(path)
        except DamagedArtifactError:
            return False
        return checkpoint is not None and checkpoint.made_from(self.origin)

    def _paths(self) -> list[Path]:
        return sorted(p for p in self.folder.glob("[0-9]*") if p.is_dir()) if self.folder.exists() else []


@dataclass(frozen=True)
class RunDirectory:
    """Where everything of one run lies."""

    path: Path

    @property
    def config(self) -> Path:
        """The resolved configuration."""
        return self.path / "config.json"

    @property
    def report(self) -> Path:
        """The report, one self-contained HTML file."""
        return self.path / "report.html"

    @property
    def events(self) -> Path:
        """What happened when: one JSON object per line. Times and worker counts belong here, not into artifacts."""
        return self.path / "events.jsonl"

    def logs(self) -> Path:
        """Standard output and error of child processes, one file each."""
        return self.path / "logs"

    def stage(self, stage: str) -> Path:
        """The artifact of a stage."""
        return self.path / "stages" / stage

    def job(self, stage: str, job: str) -> Path:
        """The artifact of a job; a stage with one job of its own name has no other artifact."""
        return self.stage(stage) if job == stage else self.path / "jobs" / stage / job

    def has_begun(self, stage: str) -> bool:
        """Return whether there are finished jobs or checkpoints of a stage."""
        return any((self.path / kind / stage).exists() for kind in ("jobs", "checkpoints"))

    def metrics(self, stage: str, job: str) -> Path:
        """What a job reported while it ran (`oodil.pipeline.metrics`)."""
        return self.path / "metrics" / stage / f"{job}.jsonl"

    def tensorboard(self, stage: str, job: str) -> Path:
        """The same for TensorBoard."""
        return self.path / "tensorboard" / stage / job

    def checkpoints(self, stage: str, job: str) -> Path:
        """The checkpoints of a job."""
        return self.path / "checkpoints" / stage / job
