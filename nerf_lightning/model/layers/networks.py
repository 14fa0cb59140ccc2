"""Small networks, also such that start from what a smaller one has learned: the same function, with room for more.

New neurons have random input weights and zero weights into the old neurons of the next layer, so the old ones are unchanged and
the new ones learn (Net2Net, Chen et al. 2016, section 2.3, without copies).
"""

from collections.abc import Iterable
from itertools import pairwise

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn import Linear


def build_layers(*widths: int) -> torch.nn.ModuleList:
    """Fully connected layers from each width to the next."""
    return torch.nn.ModuleList(Linear(i, o) for i, o in pairwise(widths))


def linear_layers(net: torch.nn.Module) -> list[Linear]:
    """The fully connected layers of a network, in order."""
    return [layer for layer in net.modules() if isinstance(layer, Linear)]


def layer_parameters(net: torch.nn.ModuleList) -> list[tuple[Tensor, Tensor]]:
    """Matrix and bias of each of `build_layers`."""
    return [(layer.get_parameter("weight"), layer.get_parameter("bias")) for layer in net]


@torch.no_grad()
def widen(wide: Iterable[Linear], narrow: Iterable[Linear], columns: Int[Tensor, "I"] | None = None) -> None:
    """Gives the first outputs of consecutive layers the weights of smaller ones.

    Args:
        wide, narrow: the layers; those of `wide` have as many outputs, or more.
        columns: for each input of the first layer of `narrow`, the matching input of `wide`; None for the first ones.
    """
    for mine, its in zip(wide, narrow, strict=True):
        kept = its.out_features
        mine.weight[:kept] = 0
        mine.weight[:kept, slice(its.in_features) if columns is None else columns] = its.weight
        mine.bias[:kept] = its.bias
        columns = None


def is_at_least_as_wide(wide: torch.nn.Module, narrow: torch.nn.Module) -> bool:
    """Whether no linear layer of a field is narrower than that of the same name in another."""
    mine = dict(wide.named_modules())
    both = ((mine.get(name), its) for name, its in narrow.named_modules())
    return all(
        one.out_features >= its.out_features for one, its in both if isinstance(one, Linear) and isinstance(its, Linear)
    )
