"""torch's Adam for losses and for known gradients, with a state of named tensors."""

from collections.abc import Sequence

import torch
from torch import Tensor


class Adam:
    """Adam over a fixed list of parameters, with its moments as named tensors for checkpoints."""

    def __init__(self, parameters: list[torch.nn.Parameter], learning_rate: float, weight_decay: float = 0.0) -> None:
        self._parameters = parameters
        self._optimizer = torch.optim.Adam(parameters, lr=learning_rate, weight_decay=weight_decay, fused=True)

    @property
    def learning_rate(self) -> float:
        """The current step size."""
        return float(self._optimizer.param_groups[0]["lr"])

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        self._optimizer.param_groups[0]["lr"] = value

    def step(self, loss: Tensor, max_grad_norm: float | None = None) -> None:
        """Take one step down the gradient of ``loss``, which is scaled down to ``max_grad_norm`` if there is one."""
        self.apply(torch.autograd.grad(loss, self._parameters), max_grad_norm)

    def apply(self, gradients: Sequence[Tensor], max_grad_norm: float | None = None) -> None:
        """Take one step by known gradients, one for each parameter."""
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        if max_grad_norm is not None:
            torch.nn.utils.clip_grad_norm_(self._parameters, max_grad_norm)
        self._optimizer.step()

    def state_dict(self) -> dict[str, Tensor]:
        """Return the moments and the step count of every parameter; empty before the first step."""
        moments = self._optimizer.state_dict()["state"]
        return {f"{i}.{name}": value for i, entry in moments.items() for name, value in entry.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state_dict`."""
        whole = self._optimizer.state_dict()
        whole["state"] = {}
        for name, value in state.items():
            index, field = name.split(".")
            whole["state"].setdefault(int(index), {})[field] = value.clone()
        self._optimizer.load_state_dict(whole)
