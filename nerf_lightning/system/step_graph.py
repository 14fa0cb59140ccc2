"""Training steps as CUDA graphs: captured once and replayed, which saves the host's time for each launch."""

import logging
from collections.abc import Callable, Hashable

import torch
from torch import Generator, Tensor

from nerf_lightning.dataset import RayBatch
from nerf_lightning.system.system import StepStats

log = logging.getLogger(__name__)

MAX_LOSS_DIFFERENCE = 1e-2
"""Relative difference between the first replay's loss and that of the same step run by itself."""

RunStep = Callable[[RayBatch, Generator], StepStats]
ComputeLosses = Callable[[RayBatch, Generator], tuple[dict[str, Tensor], StepStats]]


class StepGraph:
    """A training step as a CUDA graph.

    A graph repeats the kernels of one step with the same addresses and the same numbers from the host. It is captured again
    when one of them changes, in a step whose predecessor ran by itself on the same addresses: capturing the first step of an
    optimizer would repeat the initialization of its state.

    Args:
        device: the CUDA device.
        run_step: the whole step, with backward pass and optimizer.
        compute_losses: its forward pass, for a check of the first replay.
    """

    def __init__(self, device: torch.device, run_step: RunStep, compute_losses: ComputeLosses):
        self.run_step, self.compute_losses = run_step, compute_losses
        self.generator = torch.Generator(device)
        self.stream = torch.cuda.Stream(device)
        self.graph: torch.cuda.CUDAGraph | None = None
        self.key: Hashable = None
        """What the graph has fixed; None if there is no valid graph."""
        self.addresses: tuple[int, ...] = ()
        """Addresses of weights and optimizer state at the start of the last step."""
        self.inputs: list[Tensor] = []
        """The tensors of the batch that the graph reads."""
        self.is_verified = self.is_disabled = False

    def run(self, key: Hashable, addresses: tuple[int, ...], batch: RayBatch, seed: int) -> StepStats | None:
        """Runs a step by replaying its graph.

        Args:
            key: everything else that changes between steps and is not in `batch`; None if the step cannot be captured.
            addresses: of weights and optimizer state.
            batch: batch of the step.
            seed: seed of the step's generator.

        Returns:
            Statistics of the step, on the device; None if the caller has to run it.
        """
        is_stable, self.addresses = addresses == self.addresses, addresses
        if not is_stable or key is None or self.is_disabled:
            self.key = None
            return None
        expected = None if self.is_verified else self.compute_losses(batch, self.generator.manual_seed(seed))[1].mse
        if key != self.key:
            try:
                self._capture(batch)
            except RuntimeError as error:
                self._disable(" ".join(str(error).split()))
                return None
            self.key = key
        assert self.graph is not None  # the key is set
        torch._foreach_copy_(self.inputs, list_tensors(batch))
        self.generator.manual_seed(seed)
        self.graph.replay()
        if expected is not None:
            self.is_verified = True
            if not abs(float(self.stats.mse / expected) - 1) <= MAX_LOSS_DIFFERENCE:
                self._disable(f"the loss was {float(self.stats.mse):.3g} instead of {float(expected):.3g}")
                return None
        return self.stats.clone()  # the next replay overwrites what this one wrote

    def _capture(self, batch: RayBatch) -> None:
        own = batch.map_tensors(torch.clone)
        # The old graph keeps their common memory until the new one has it.
        graph, pool = torch.cuda.CUDAGraph(), None if self.graph is None else self.graph.pool()
        graph.register_generator_state(self.generator)
        torch.cuda.synchronize()
        with torch.cuda.stream(self.stream):
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                self.stats = self.run_step(own, self.generator)
            finally:
                graph.capture_end()
        self.graph, self.inputs = graph, list_tensors(own)

    def _disable(self, reason: str) -> None:
        log.warning("no CUDA graphs of training steps, which run operation by operation instead: %s", reason)
        self.is_disabled, self.key, self.graph = True, None, None


def list_tensors(batch: RayBatch) -> list[Tensor]:
    """Tensors of a batch, in the order of its fields."""
    tensors: list[Tensor] = []

    def append(x: Tensor) -> Tensor:
        tensors.append(x)
        return x

    batch.map_tensors(append)
    return tensors


def list_addresses(module: torch.nn.Module, optimizer: torch.optim.Optimizer) -> tuple[int, ...]:
    """Addresses of a module's parameters and their optimizer state."""
    return tuple(
        x.data_ptr()
        for parameter in module.parameters()
        for x in (parameter, *optimizer.state.get(parameter, {}).values())
        if isinstance(x, Tensor)
    )
