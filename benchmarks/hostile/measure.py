"""All cases, one after the other, and the table of what became of them."""

import gc
import importlib
import json
import os
import pkgutil
import shutil
import tempfile
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import torch

import nerf_lightning
from benchmarks.hostile import good, kinds, verdict
from benchmarks.hostile.case import Command, Ended, Limits, run
from benchmarks.hostile.verdict import BAD, OUTCOMES, Verdict
from nerf_lightning.utils.files import write_json

TIMES = 8
"""Limits against what the hungriest good command takes: damage may leave something twice as wide, as high and as many."""

TOLD = 250
"""Cases between two lines about how far it is."""


@dataclass(frozen=True)
class Ready:
    """What all cases start from."""

    good: Path
    """Folder of the good inputs."""
    options: dict[str, dict[str, str]]
    """Of each verb, see `good.options_of`."""
    limits: Limits


def get_ready(folder: Path) -> Ready:
    """Makes the good inputs, and imports in this process whatever a case may need, so that none waits for it.

    Nothing is computed here, but in processes of their own: threads of PyTorch's would not survive a fork. The limits follow
    from what these processes took.

    Raises:
        RuntimeError: where a command fails on good input.
    """
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    os.environ.pop("NERF_LIGHTNING_TRACEBACK", None)
    os.environ["NERF_LIGHTNING_CACHE"] = str(folder / "cache")
    for module in pkgutil.walk_packages(nerf_lightning.__path__, "nerf_lightning."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    options = {verb: good.options_of(verb, folder) for verb in good.VERBS}
    (folder / "good").mkdir(parents=True)
    commands = [Command(kinds.module("inspect"), ("--help",))]  # while it is prepared, everything is written
    for verb, words in good.MADE:
        commands.append(Command(kinds.module(verb), tuple(one.format(good=folder / "good") for one in words)))
    seconds, room = 0.0, 0
    for number, command in enumerate(commands):

        def prepare(work: Path, marker: Path, number: int = number, command: Command = command) -> Command:
            if number == 0:
                good.write(folder / "good")
            return command

        ended = run(prepare, folder / "made" / str(number), None)
        if ended.code != 0:
            raise RuntimeError(f"{command} failed: {ended.err}")
        seconds, room = max(seconds, ended.seconds), max(room, ended.grown)
        for name in ended.modules:
            with suppress(ImportError):  # made while it ran
                importlib.import_module(name)
    gc.freeze()  # so that a child does not copy what it only looks at
    return Ready(folder / "good", options, Limits(TIMES * seconds, TIMES * room))


def one(case: kinds.Case, ready: Ready, folder: Path) -> tuple[Verdict, Ended, Command, str]:
    """Runs a case in an empty folder: what became of it, how it ended, the command and what was done to its input."""

    def prepare(work: Path, marker: Path) -> Command:
        command, done = kinds.prepare(case, ready.good, ready.limits.room, ready.options, work, marker)
        about = {"module": command.module, "arguments": command.arguments, "done": done}
        (work.parent / "said" / "about").write_text(json.dumps(about), encoding="utf-8")
        return command

    ended = run(prepare, folder, ready.limits)
    about = json.loads((folder / "said" / "about").read_text(encoding="utf-8"))
    command = Command(about["module"], tuple(about["arguments"]))
    found = verdict.judge(ended, command, ready.limits, folder, harmed=bool(about["done"]))
    return found, ended, command, about["done"]


def again(case: kinds.Case) -> str:
    """The command that repeats a case."""
    return f"python -m benchmarks hostile --seeds {case.seed} --case {case.number}"


def measure(seeds: list[int], cases: int, single: int | None, output: Path) -> dict[str, list[dict[str, Any]]]:
    """Tables: what became of the cases of each kind, and the causes of what is bad, most frequent first.

    Args:
        seeds: of the cases.
        cases: of each seed.
        single: the number of one case, to be run alone and shown in full; its folder is kept in `output`.
        output: where to write.
    """
    rows: dict[str, Counter[str]] = {}
    causes: dict[tuple[str, str], list[dict[str, Any]]] = {}
    accepted: list[dict[str, Any]] = []
    numbers = range(cases) if single is None else [single]
    with tempfile.TemporaryDirectory(prefix="hostile-") as below:
        ready, folder = get_ready(Path(below)), Path(below) / "case"
        seconds, room = ready.limits.seconds, ready.limits.room
        print(f"hostile: {seconds:.1f} s of the processor and {room / 1e6:.0f} MB a case", flush=True)
        for case in (kinds.Case(seed, number) for seed in seeds for number in numbers):
            found, ended, command, done = one(case, ready, folder)
            counts = rows.setdefault(case.kind.name, Counter())
            counts.update(["tried", found.outcome])
            about = {"case": again(case), "kind": case.kind.name, "verb": command.verb, "done": done}
            if found.outcome == "accepted":
                accepted.append(about)
            if found.outcome in BAD:
                causes.setdefault((found.outcome, found.cause), []).append({**about, "said": ended.err[-2000:]})
                print(f"{found.outcome}: {again(case)}  # {case.kind.name}, {command.verb}: {done[:100]!r}", flush=True)
            if single is not None:
                show(found, ended, command, done)
                shutil.copytree(folder, output / f"case_{case.seed}_{case.number}", symlinks=True, dirs_exist_ok=True)
            elif (case.number + 1) % TOLD == 0:
                print(f"hostile: seed {case.seed}, {case.number + 1:,} of {cases:,} cases", flush=True)
            shutil.rmtree(folder)
    whole = sum(rows.values(), Counter[str]())
    table = [{"kind": kind.name, **_counts(rows[kind.name])} for kind in kinds.KINDS if kind.name in rows]
    frequent = sorted(causes.items(), key=lambda item: -len(item[1]))
    found_causes = [
        {
            "cases": len(alike),
            "outcome": outcome,
            "cause": cause[:160],
            **{key: alike[0][key] for key in ("case", "verb")},
        }
        for (outcome, cause), alike in frequent
    ]
    write_json(output / "hostile" / "accepted.json", accepted)
    for number, ((outcome, cause), alike) in enumerate(frequent):
        write_json(output / "hostile" / f"{number:03d}.json", {"outcome": outcome, "cause": cause, "cases": alike})
    return {"hostile": [*table, {"kind": "all", **_counts(whole)}], "hostile causes": found_causes}


def _counts(counts: Counter[str]) -> dict[str, int]:
    return {key: counts[key] for key in ("tried", *OUTCOMES)}


def show(found: Verdict, ended: Ended, command: Command, done: str) -> None:
    """Prints a case in full."""
    print(f"python -m {command.module} {' '.join(command.arguments)}"[:4000])
    print(f"input: {done or 'left as it is'}")
    print(f"outcome: {found.outcome}: {found.cause}")
    print(
        f"exit code {ended.code}, {ended.seconds:.1f} s, {ended.grown / 1e6:.0f} MB, new: {', '.join(ended.new)[:500]}"
    )
    print(f"--- out\n{ended.out}--- err\n{ended.err}---", flush=True)
