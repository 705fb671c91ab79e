"""Policies as PyTorch modules."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import Error

if TYPE_CHECKING:
    from .policy import Policy


def module(policy: Policy) -> Any:
    """See :meth:`tce.Policy.to_torch`."""
    import torch
    from torch import nn

    if policy.recurrent:
        raise Error("to_torch: found a policy that remembers its episode; expected a function of the observation")
    tensors, metadata = policy.parameters()
    spec = metadata["policy"]
    activations = {"identity": nn.Identity, "relu": nn.ReLU, "silu": nn.SiLU, "tanh": nn.Tanh}

    class PolicyModule(nn.Module):  # type: ignore[misc, unused-ignore]
        """Standardise, clip, perceptron, head, units."""

        def __init__(self) -> None:
            super().__init__()
            inputs = spec["inputs"]
            mean = np.array(spec["standardizer"]["mean"], np.float32)[inputs]
            std = np.array(spec["standardizer"]["std"], np.float32)[inputs]
            self.register_buffer("inputs", torch.tensor(inputs))
            self.register_buffer("mean", torch.from_numpy(mean))
            self.register_buffer("std", torch.from_numpy(std))
            low, high = policy.action_range
            self.register_buffer("low", torch.from_numpy(low))
            self.register_buffer("high", torch.from_numpy(high))
            self.clip = spec["clip"]
            self.squashed = spec["head"] == "tanh_gaussian"
            layers: list[nn.Module] = []
            last = len(spec["hidden"])
            for k in range(last + 1):
                weight, bias = (tensors[f"policy.layers.{k}.{part}"][0] for part in ("weight", "bias"))
                layer = nn.Linear(*weight.shape)
                with torch.no_grad():
                    layer.weight.copy_(torch.from_numpy(np.ascontiguousarray(weight.T)))
                    layer.bias.copy_(torch.from_numpy(bias.reshape(-1).copy()))
                layers += [layer, activations[spec["output_activation" if k == last else "activation"]]()]
            self.network = nn.Sequential(*layers)

        def forward(self, observation: Any) -> Any:
            low: Any = self.low
            high: Any = self.high
            x = (observation[:, self.inputs] - self.mean) / self.std
            if self.clip is not None:
                x = x.clamp(-self.clip, self.clip)
            out = self.network(x)
            action = torch.tanh(out[:, : policy.action_size]) if self.squashed else out.clamp(-1.0, 1.0)
            return low + (action + 1.0) * 0.5 * (high - low)

    return PolicyModule().eval()
