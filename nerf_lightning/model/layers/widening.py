"""Networks that take up what a smaller one has learned: the same function, with room for more.

New neurons start with random weights towards their inputs and none towards the old neurons behind them, so that the old ones go
on as before and the new ones learn (Net2Net, Chen et al. 2016, section 2.3, without copies).
"""

import torch
from jaxtyping import Int
from torch import Tensor


@torch.no_grad()
def widen(wide: torch.nn.Linear, narrow: torch.nn.Linear, columns: Int[Tensor, "I"]) -> None:
    """Gives the first outputs of a layer the weights of a smaller one.

    Args:
        wide, narrow: the layers; `wide` has as many outputs, or more.
        columns: which input of `wide` each input of `narrow` has become.
    """
    kept = narrow.out_features
    wide.weight[:kept] = 0
    wide.weight[:kept, columns] = narrow.weight
    wide.bias[:kept] = narrow.bias


def widen_all(wide: torch.nn.ModuleList, narrow: torch.nn.ModuleList, columns: Int[Tensor, "I"]) -> None:
    """The same for layers in a row; `columns` are those of the first."""
    for mine, its in zip(wide, narrow, strict=True):
        assert isinstance(mine, torch.nn.Linear) and isinstance(its, torch.nn.Linear)
        widen(mine, its, columns)
        columns = torch.arange(its.out_features)
