"""What is lost when a process is told to end at any moment: nothing that was done, and it goes on to the same result.

Each long command runs once undisturbed. Then it is started again and again in folders of its own, gets SIGINT, SIGTERM or
SIGKILL after a random time, and is given once more (training: with the `resume=` that its last line tells). What it leaves
then must be what the undisturbed one left, to the last bit; times and what follows from them are not compared.
"""

import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

HOW = ("told", "killed", "ended before", "other")
"""A signal that a command answers, SIGKILL, too late for either, and what should not happen."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
LONGEST = 120.0
"""Seconds after a signal in which a command, and all processes that it has started, must have ended."""
HANGS = 124
"""Exit code of one that has not, as `timeout` gives."""
BRICKS = ("dataset=bricks", "dataset.size=48", "dataset.train_views=16", "dataset.val_views=2", "threads=1")
TRAINING = (
    *BRICKS,
    "device=cpu",
    "recipe=tensorf_small",
    "callbacks.checkpoints.every_seconds=0.5",
    "callbacks.orbit.frames=4",
)
TIMES = re.compile("^run$|second|time|speed|date|load|machine|energy|memory|started|ended|path|folder|per_s")
"""What keys say that hold times, or what is different from process to process."""


def weights(folder: Path) -> str:
    """Of all runs below a folder: digest of the step and the weights at the end."""
    sha = hashlib.sha256()
    for path in sorted(folder.rglob("last.ckpt")):
        state = torch.load(path, weights_only=True)
        sha.update(f"{path.relative_to(folder)} {state['global_step']}".encode())
        for key, value in sorted(state["state_dict"].items()):
            sha.update(key.encode() + value.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return sha.hexdigest()


def timeless(value: Any) -> Any:
    """JSON without what depends on the clock."""
    if isinstance(value, dict):
        return {key: timeless(one) for key, one in value.items() if not TIMES.search(key)}
    return [timeless(one) for one in value] if isinstance(value, list) else value


def figures(folder: Path) -> str:
    """Digest of the JSON files that a command leaves right in its folder, without times."""
    told = {path.name: timeless(json.loads(path.read_text(encoding="utf-8"))) for path in sorted(folder.glob("*.json"))}
    return json.dumps(told, sort_keys=True)


def pictures(folder: Path) -> str:
    """Digest of all files."""
    return " ".join(hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.rglob("*.*")))


@dataclass(frozen=True)
class Job:
    """A long command."""

    words: Callable[[Path], tuple[str, ...]]
    """Its arguments after `python -m`, with a folder to write to."""
    left: tuple[Callable[[Path], str], ...]
    """What it leaves in the folder, to be compared."""


def jobs(run: Path) -> dict[str, Job]:
    """The commands, by name.

    Args:
        run: a trained run, to be rendered.
    """
    return {
        "train": Job(lambda out: ("nerf_lightning", *TRAINING, "budget.steps=200", f"hydra.run.dir={out}"), (weights,)),
        "sweep": Job(
            lambda out: ("nerf_lightning", "-m", *TRAINING, "seed=0,1", "budget.steps=100", f"hydra.sweep.dir={out}"),
            (weights,),
        ),
        "rightsize": Job(
            lambda out: ("nerf_lightning.rightsize", *TRAINING, "budget.steps=100", "target.psnr=21", f"output={out}"),
            (weights, figures),
        ),
        "stability": Job(
            lambda out: ("nerf_lightning.stability", "methods=[hashgrid]", "seeds=1", "steps=20", f"output={out}"),
            (figures,),
        ),
        "render": Job(
            lambda out: (
                "nerf_lightning.render",
                f"run={run}",
                "frames=30",
                "scale=4",
                "device=cpu",
                f"output={out}/film.webp",
            ),
            (pictures,),
        ),
    }


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    err: str
    seconds: float


def start(words: tuple[str, ...], after: float | None = None, number: int = 0) -> Ended:
    """Runs a command, and sends it a signal after so many seconds unless it has ended."""
    began = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    hangs = False
    try:
        _, err = process.communicate(timeout=after)
    except subprocess.TimeoutExpired:  # it is still at work
        process.send_signal(number)
        try:
            _, err = process.communicate(timeout=LONGEST)
        except subprocess.TimeoutExpired:  # so is it, or a process that it has left behind
            os.killpg(process.pid, signal.SIGKILL)
            _, err = process.communicate()
            hangs, err = True, f"{err}still at work {LONGEST:.0f} s after the signal"
    return Ended(HANGS if hangs else process.returncode, err, time.monotonic() - began)


def wrong(job: Job, out: Path, wanted: list[str], after: float, number: int) -> tuple[str, str]:
    """How a command ended that got a signal, one of `HOW`, and what is wrong about it; "" where nothing is."""
    words = job.words(out)
    ended = start(words, after, number)
    last = ended.err[-300:]
    if ended.code == 0:
        how = "ended before"
    elif number == signal.SIGKILL and ended.code == -number:
        how = "killed"
    elif number != signal.SIGKILL and ended.code == 128 + number:
        how = "told"
        if ended.err.count("nerf_lightning: interrupted") != 1 or "Traceback" in ended.err:
            return how, f"said {last!r}"
        if left := [path.name for path in out.rglob(".*") if path.name != ".lock"]:
            return how, f"left {left[0]}"
    else:
        return "other", f"exit code {ended.code}: {last!r}"
    if how != "ended before":
        resume = re.search(r"resume=\S+", ended.err)
        if resume:
            words = ("nerf_lightning", resume[0])
        elif how == "killed" and (out / "checkpoints" / "last.ckpt").is_file():
            words = ("nerf_lightning", f"resume={out}")
        again = start(words)
        if again.code != 0:
            return how, f"again: exit code {again.code}: {again.err[-300:]!r}"
    different = [look.__name__ for look, value in zip(job.left, wanted, strict=True) if look(out) != value]
    return how, f"other {' and '.join(different)}" if different else ""


def at_random_moments(
    name: str, job: Job, seeds: list[int], moments: int, folder: Path, output: Path
) -> dict[str, Any]:
    """A line of the table; folders of what went wrong are kept in `output`.

    Raises:
        RuntimeError: where the command fails undisturbed.
    """
    whole = folder / "whole"
    usual = start(job.words(whole))
    if usual.code != 0:
        raise RuntimeError(f"{name} failed undisturbed: {usual.err}")
    wanted = [look(whole) for look in job.left]

    def one(seed: int, moment: int) -> list[str]:
        number, out = SIGNALS[moment % len(SIGNALS)], folder / f"{seed}_{moment}"
        after = random.Random(f"{seed} {name} {moment}").uniform(0, usual.seconds)
        how, found = wrong(job, out, wanted, after, number)
        if found:
            print(f"signals: {name}, {signal.Signals(number).name} after {after:.2f} s: {found}", flush=True)
            if out.exists():
                shutil.copytree(out, output / f"{name}_{seed}_{moment}", dirs_exist_ok=True)
        shutil.rmtree(out, ignore_errors=True)
        return ["tried", how, *(["wrong"] if found else [])]

    with ThreadPoolExecutor(os.cpu_count()) as pool:  # each command computes in one thread
        waiting = [pool.submit(one, seed, moment) for seed in seeds for moment in range(moments)]
        counts = Counter(key for each in waiting for key in each.result())
    row = {"command": name, "seconds": usual.seconds, **{key: counts[key] for key in ("tried", *HOW, "wrong")}}
    print("signals: " + ", ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    return row


def measure(seeds: list[int], moments: int, commands: list[str], output: Path) -> dict[str, list[dict[str, Any]]]:
    """A line a command: how it ended at random moments, and how often something was lost.

    Args:
        seeds: of the moments.
        moments: how many a command and seed.
        commands: which; none: all.
        output: keeps the folders of what went wrong.

    Raises:
        RuntimeError: where a command fails undisturbed.
    """
    with tempfile.TemporaryDirectory(prefix="signals-") as below:
        trained = Path(below) / "trained"
        known = jobs(trained)
        start(known["train"].words(trained))
        chosen = {name: known[name] for name in commands or known}
        rows = [
            at_random_moments(name, job, seeds, moments, Path(below) / name, output) for name, job in chosen.items()
        ]
    return {"signals": rows}
