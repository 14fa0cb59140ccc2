"""Small networks, and warm starts of wide ones from narrow ones (Net2Net, Chen et al. 2016, section 2.3, without copies).

New neurons have random input weights and zero weights into the old neurons of the next layer: the function is preserved.
"""

from collections.abc import Iterable
from itertools import pairwise

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn import Linear


def build_layers(*widths: int) -> torch.nn.ModuleList:
    """Linear layers from each width to the next."""
    return torch.nn.ModuleList(Linear(i, o) for i, o in pairwise(widths))


def linear_layers(net: torch.nn.Module) -> list[Linear]:
    """Linear layers of a network, in order."""
    return [x for x in net.modules() if isinstance(x, Linear)]


def layer_parameters(net: torch.nn.ModuleList) -> list[tuple[Tensor, Tensor]]:
    """Matrix and bias of each layer of `build_layers`."""
    return [(x.get_parameter("weight"), x.get_parameter("bias")) for x in net]


@torch.no_grad()
def widen(wide: Iterable[Linear], narrow: Iterable[Linear], columns: Int[Tensor, "I"] | None = None) -> None:
    """Copies the weights of consecutive narrow layers into the first outputs of wide ones.

    Args:
        wide, narrow: linear layers; no layer of `wide` has fewer outputs than its counterpart.
        columns: input of the first layer of `wide` for each input of its counterpart; None: the first ones.
    """
    for ours, theirs in zip(wide, narrow, strict=True):
        narrow_outputs = theirs.out_features
        ours.weight[:narrow_outputs] = 0
        ours.weight[:narrow_outputs, slice(theirs.in_features) if columns is None else columns] = theirs.weight
        ours.bias[:narrow_outputs] = theirs.bias
        columns = None


def is_at_least_as_wide(wide: torch.nn.Module, narrow: torch.nn.Module) -> bool:
    """Whether no linear layer of `wide` is narrower than the layer of the same name in `narrow`."""
    ours = dict(wide.named_modules())
    pairs = ((ours.get(name), theirs) for name, theirs in narrow.named_modules())
    return all(x.out_features >= y.out_features for x, y in pairs if isinstance(x, Linear) and isinstance(y, Linear))
