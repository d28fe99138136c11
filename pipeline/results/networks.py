"""Files of networks that more than one artifact has."""

from dataclasses import fields
from typing import Any

from numpy.typing import NDArray

from oodil.pipeline.artifacts import Artifact, Files, encode_arrays
from oodil.pipeline.errors import DamagedArtifactError
from oodil.pipeline.policy import GaussianPolicy

_POLICY = "policy.safetensors"
_DISCRIMINATOR = "discriminator.safetensors"
_VALUE = "value.safetensors"

Arrays = dict[str, NDArray[Any]]


def policy_file(policy: GaussianPolicy) -> Files:
    """Return the file of a policy."""
    return {_POLICY: encode_arrays(policy.arrays())}


def load_policy(artifact: Artifact) -> GaussianPolicy:
    """Return a policy. Raises DamagedArtifactError for arrays that are none."""
    try:
        return GaussianPolicy.from_arrays(artifact.arrays(_POLICY))
    except ValueError as error:
        raise DamagedArtifactError(f"{artifact.path / _POLICY}: {error}") from error


def discriminator_file(arrays: Arrays) -> Files:
    """Return the file of a discriminator's parameters."""
    return {_DISCRIMINATOR: encode_arrays(arrays)}


def load_discriminator(artifact: Artifact) -> Arrays:
    """Return a discriminator's parameters by name."""
    return artifact.arrays(_DISCRIMINATOR)


def value_file(arrays: Arrays) -> Files:
    """Return the file of a policy's value function, with which its training can be continued."""
    return {_VALUE: encode_arrays(arrays)}


def load_value(artifact: Artifact) -> Arrays:
    """Return a value function's parameters by name."""
    return artifact.arrays(_VALUE)


def fields_of(artifact: Artifact, name: str, kind: type) -> Arrays:
    """Return the arrays of a file by the fields of the type that holds them."""
    arrays = artifact.arrays(name)
    return {each.name: arrays[each.name] for each in fields(kind)}
