"""Networks that start from what a smaller one has learned: the same function, with room for more.

New neurons have random input weights and zero weights into the old neurons of the next layer, so the old ones are unchanged and
the new ones learn (Net2Net, Chen et al. 2016, section 2.3, without copies).
"""

import torch
from jaxtyping import Int
from torch import Tensor


@torch.no_grad()
def widen(wide: torch.nn.Linear, narrow: torch.nn.Linear, columns: Int[Tensor, "I"]) -> None:
    """Gives the first outputs of a layer the weights of a smaller one.

    Args:
        wide, narrow: the layers; `wide` has as many outputs, or more.
        columns: for each input of `narrow`, the matching input of `wide`.
    """
    kept = narrow.out_features
    wide.weight[:kept] = 0
    wide.weight[:kept, columns] = narrow.weight
    wide.bias[:kept] = narrow.bias


def as_wide(wide: torch.nn.Module, narrow: torch.nn.Module) -> bool:
    """Whether no linear layer of a field is narrower than that of the same name in another."""
    mine = dict(wide.named_modules())
    both = ((mine.get(name), its) for name, its in narrow.named_modules())
    return all(
        one.out_features >= its.out_features
        for one, its in both
        if isinstance(one, torch.nn.Linear) and isinstance(its, torch.nn.Linear)
    )


def widen_all(wide: torch.nn.ModuleList, narrow: torch.nn.ModuleList, columns: Int[Tensor, "I"]) -> None:
    """The same for consecutive layers; `columns` are the first one's."""
    for mine, its in zip(wide, narrow, strict=True):
        assert isinstance(mine, torch.nn.Linear) and isinstance(its, torch.nn.Linear)
        widen(mine, its, columns)
        columns = torch.arange(its.out_features)
