"""A policy as an ONNX model that maps raw observations to the actions to apply, with nothing to do before or after.

Standardization, clipping and the bounds of the action space are inside, as in `Policy.act`. Needs the extra
``oodil[onnx]``. Letters: B batch, S observation, A action, H hidden.
"""

import json
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from oodil.pipeline.artifacts import write_file
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.policy import action_units
from oodil.pipeline.results import Policy

OPSET, IR_VERSION = 17, 8
"""Of 2022, so that runtimes on robots know them; nothing newer is needed."""


class _Graph:
    """A chain of nodes: each takes what the one before it gave, and constants."""

    def __init__(self, given: str) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._value = given

    def then(self, operator: str, result: str, **constants: NDArray[np.generic]) -> None:
        """Apply an operator of ONNX, whose further inputs are the ``constants`` in their order."""
        names = [f"{result}.{name}" for name in constants]
        self.nodes.append(helper.make_node(operator, [self._value, *names], [result], name=result))
        self.constants += [
            numpy_helper.from_array(np.asarray(each), name)
            for name, each in zip(names, constants.values(), strict=True)
        ]
        self._value = result


def write_onnx(policy: Policy, name: str, path: Path) -> None:
    """Write a policy. Raises ConfigError for another ending than .onnx, StorageError if it cannot be written."""
    if path.suffix != ".onnx":
        raise ConfigError(f"{path}: a model's file ends in .onnx")
    write_file(path, onnx_model(policy, name).SerializeToString())


def onnx_model(policy: Policy, name: str) -> onnx.ModelProto:
    """Return the model: ``observation`` (B, ...) to ``action`` (B, ...), both float32 in the shapes of their spaces."""
    graph = _Graph("observation")
    _mean(graph, policy)
    _to_action_space(graph, policy)
    shapes = {"observation": policy.observation_shape, "action": policy.action_low.shape}
    seen, action = (
        helper.make_tensor_value_info(each, TensorProto.FLOAT, ["batch", *shape]) for each, shape in shapes.items()
    )
    model = helper.make_model(
        helper.make_graph(graph.nodes, name, [seen], [action], graph.constants),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="oodil",
    )
    helper.set_model_props(model, {"environment": policy.environment_id, "env_steps": json.dumps(policy.env_steps)})
    onnx.checker.check_model(model, full_check=True)
    return model


def _mean(graph: _Graph, policy: Policy) -> None:
    """Add `GaussianPolicy.mean` of flattened observations: (B, ...) to (B, A)."""
    gaussian = policy.gaussian
    graph.then("Reshape", "flat", shape=np.array([-1, len(gaussian.input_mean)], np.int64))
    graph.then("Sub", "centered", mean=gaussian.input_mean)
    graph.then("Mul", "standardized", scale=gaussian.input_scale)
    if gaussian.input_limit < np.inf:
        limit = np.float32(gaussian.input_limit)
        graph.then("Clip", "limited", low=np.asarray(-limit), high=np.asarray(limit))
    for i, (weight, bias) in enumerate(zip(gaussian.weights, gaussian.biases, strict=True)):
        if i:
            graph.then("Tanh", f"hidden_{i}")
        graph.then("Gemm", f"layer_{i}", weight=weight, bias=bias)


def _to_action_space(graph: _Graph, policy: Policy) -> None:
    """Add what `Policy.act` makes of the network's (B, A) output: actions (B, ...) in the numbers of their space."""
    middle, half = action_units(policy.action_low, policy.action_high)
    graph.then("Reshape", "shaped", shape=np.array([-1, *policy.action_low.shape], np.int64))
    graph.then("Mul", "scaled", half=half)
    graph.then("Add", "moved", middle=middle)
    graph.then("Max", "raised", low=policy.action_low)
    graph.then("Min", "lowered" if policy.acts_in_integers else "action", high=policy.action_high)
    if policy.acts_in_integers:
        graph.then("Round", "action")
