"""What a run goes on from, beside weights: where a checkpoint holds something else, it is refused as it is read."""

import copy
import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from nerf_lightning.callbacks import Budget, Guard, HeldOut, Throughput
from nerf_lightning.callbacks.plateau import Plateau
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.refine import Corrections
from nerf_lightning.synthetic.objects import MARBLE, make_scene

WRONG = (None, "text", [], {}, [None], {"a": 1}, math.nan, -math.inf, 10**400, -(10**12), torch.zeros(2, 2))


def data(learned: bool) -> tuple[Callable[[], dict], Callable[[dict], None]]:
    module = RayDataModule(make_scene(MARBLE, size=16, views=3, held_out=1), rays=50, samples=None)
    if learned:
        for step in range(20):
            module.note_errors(module.draw(step).pixels.float().mean(1) / 255)
    return module.state_dict, module.load_state_dict


def guard(learned: bool) -> tuple[Callable[[], dict], Callable[[dict], None]]:
    made = Guard()
    if learned:
        made.watch.level, made.watch.earlier, made.watch.lowest = 0.1, [0.3, 0.2], 0.1
    return made.state_dict, made.load_state_dict


def budget(learned: bool) -> tuple[Callable[[], dict], Callable[[dict], None]]:
    made = Budget(steps=9, patience=0.1)
    assert isinstance(made.plateau, Plateau)
    if learned:
        made.plateau.points = [(1.0, 20.0), (2.0, 21.0)]
        made.stopped = {"seconds": 2.0, "step": 5, "rest_db": 0.1}
    return made.state_dict, made.load_state_dict


def held_out(learned: bool) -> tuple[Callable[[], dict], Callable[[dict], None]]:
    made = HeldOut([0.5])
    if learned:
        made.curve = [[1.0, 5, 20.0]]
    return made.state_dict, made.load_state_dict


def throughput(learned: bool) -> tuple[Callable[[], dict], Callable[[dict], None]]:
    made = Throughput()
    made.rays = 4096 if learned else 0
    return made.state_dict, made.load_state_dict


def corrections(learned: bool) -> tuple[Callable[[], dict], Callable[[dict], None]]:
    scene = make_scene(MARBLE, size=16, views=3, held_out=1)
    made = Corrections(scene.train.cameras, scene.bounds, auto=True)
    if learned:
        made.note(30, 0.1, {"poses": 1.0, "light": 0.0, "stated": 0.0})
        assert made.since
    return made.decided, made.decide


def places(value: Any, at: tuple = ()) -> Iterator[tuple]:
    yield at
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in inside:
        yield from places(one, (*at, key))


def kinds(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: kinds(one) for key, one in value.items()}
    if isinstance(value, list):
        return [kinds(one) for one in value]
    if isinstance(value, int | float):
        return type(float(value))  # which fails where no float can hold it
    return "a tensor" if isinstance(value, torch.Tensor) else value


def could_be(found: Any, right: Any) -> bool:
    """Whether a state is made like another; what is none yet, or not any more, may be missing, and lists may be shorter."""
    if isinstance(right, dict) and isinstance(found, dict):
        return not found or all(key in found and could_be(found[key], one) for key, one in right.items())
    if isinstance(right, list) and isinstance(found, list):
        return all(could_be(one, right[0]) for one in found) if right else not found
    return found is None or found == right


def test_a_state_of_before_a_plateau_has_none():
    stopped, running = Budget(steps=9, patience=0.1), Budget(steps=9, patience=0.1)
    stopped.stopped = {"seconds": 2.0, "step": 5, "rest_db": 0.1}
    stopped.load_state_dict(running.state_dict())
    assert stopped.state_dict() == running.state_dict()


@pytest.mark.parametrize("make", [data, guard, budget, held_out, throughput, corrections])
def test_what_is_none_of_it_is_refused_or_becomes_what_it_must_be(make: Callable):
    state, _ = make(True)
    good = state()
    kept, load = make(False)
    load(copy.deepcopy(good))
    assert kinds(kept()) == kinds(good)
    refused = 0
    for at in places(good):
        for wrong in WRONG:
            spoilt = {"whole": copy.deepcopy(good)}
            node: Any = spoilt
            for key in ("whole", *at)[:-1]:
                node = node[key]
            node[("whole", *at)[-1]] = wrong
            kept, load = make(False)
            try:
                load(spoilt["whole"])
            except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError):
                refused += 1
            else:
                assert could_be(kinds(kept()), kinds(good)), (at, wrong)
    assert refused > len(WRONG)
