"""The policy that travels: a Gaussian whose mean is a small tanh network, evaluated with NumPy alone.

Rollout workers need nothing but this file and a simulator, so they start fast and stay small. The network that is
trained lives in `oodil.pipeline.algorithms.networks`; a test holds the two together.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

LARGEST_INPUT = 10.0
"""Where standardized inputs of networks are clipped, see `GaussianPolicy.input_limit`."""


_UNBOUNDED = 1e30
"""A bound as large as this is none."""


def has_bounds(low: NDArray[np.floating], high: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which actions have two finite bounds; the others are not scaled."""
    return (np.abs(low) < _UNBOUNDED) & (np.abs(high) < _UNBOUNDED)


def action_units(
    low: NDArray[np.floating], high: NDArray[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return ``(middle, half)`` of the bounds of actions: an action of x in units is ``middle + half * x`` in numbers.

    So what lies between two finite bounds is [-1, 1], and an action without them is taken as it is: 0 and 1.
    """
    bounded = has_bounds(low, high)
    below, above = np.where(bounded, low, -1), np.where(bounded, high, 1)
    return (below / 2 + above / 2).astype(low.dtype), (above / 2 - below / 2).astype(low.dtype)


class Controller(Protocol):
    """Whatever acts: a policy, or a controller that somebody wrote."""

    def mean(self, observations: NDArray[np.float64]) -> Array:
        """Return (G, A) actions for (G, S) observations."""


@dataclass(frozen=True)
class GaussianPolicy:
    """Action = mean(observation) + exp(log_std) * noise. Letters: G simulators, S observation, A action, H hidden."""

    weights: tuple[Array, ...]
    """Layer matrices (inputs, outputs), tanh between them."""
    biases: tuple[Array, ...]
    log_std: Array
    """(A,), independent of the observation."""
    input_mean: Array
    """(S,) subtracted from the observation."""
    input_scale: Array
    """(S,) multiplied afterwards."""
    input_limit: float = float("inf")
    """Standardized inputs are clipped here. A dimension that hardly moves in the demonstrations, such as the height
    of a box, moves by a hundred of its deviations once something falls, and would saturate the network."""

    def mean(self, observations: NDArray[np.float64]) -> Array:
        """Return (G, A) mean actions, which are also the deterministic ones, for (G, S) observations."""
        # In place and by `dot`, which for matrices this small saves a fifth of the time.
        hidden = observations.astype(np.float32) - self.input_mean
        hidden *= self.input_scale
        if self.input_limit < np.inf:
            np.clip(hidden, -self.input_limit, self.input_limit, out=hidden)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = hidden.dot(weight)
            hidden += bias
            np.tanh(hidden, out=hidden)
        output: Array = hidden.dot(self.weights[-1])
        output += self.biases[-1]
        return output

    def log_prob_of_noise(self, noise: Array) -> Array:
        """Return (...) log-densities of the actions that the standard normal ``noise`` (..., A) gives."""
        constant = np.float32(0.5 * np.log(2 * np.pi) * noise.shape[-1]) + self.log_std.sum()
        return np.asarray(-0.5 * np.square(noise).sum(axis=-1) - constant)

    def arrays(self) -> dict[str, Array]:
        """Return the parameters by name, for messages and files; `from_arrays` is the inverse."""
        named = {"log_std": self.log_std, "input_mean": self.input_mean, "input_scale": self.input_scale}
        named["input_limit"] = np.array(self.input_limit, np.float32)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            named[f"weight_{i}"], named[f"bias_{i}"] = weight, bias
        return named

    @classmethod
    def from_arrays(cls, arrays: dict[str, Array]) -> "GaussianPolicy":
        """Rebuild a policy from `arrays`. Raises ValueError when a name is missing or shapes do not chain."""
        depth = sum(name.startswith("weight_") for name in arrays)
        try:
            weights = tuple(arrays[f"weight_{i}"] for i in range(depth))
            biases = tuple(arrays[f"bias_{i}"] for i in range(depth))
            limit = float(arrays.get("input_limit", np.inf))  # Experts that were saved without one have none.
            policy = cls(weights, biases, arrays["log_std"], arrays["input_mean"], arrays["input_scale"], limit)
        except KeyError as error:
            raise ValueError(f"policy has no array {error.args[0]!r}") from None
        widths = [len(policy.input_mean), *(len(bias) for bias in biases)]
        for i, weight in enumerate(weights):
            if weight.shape != (widths[i], widths[i + 1]):
                raise ValueError(f"policy layer {i} has shape {weight.shape}; expected {(widths[i], widths[i + 1])}")
        if not weights or policy.log_std.shape != (widths[-1],) or policy.input_scale.shape != (widths[0],):
            raise ValueError("policy arrays do not fit together")
        return policy
