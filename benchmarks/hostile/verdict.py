"""What became of a case."""

import json
import math
import re
import signal
from dataclasses import dataclass
from pathlib import Path

from benchmarks.hostile.case import Command, Ended, Limits

GOOD = ("answered", "warned", "accepted")
BAD = ("traceback", "hang", "over memory", "code run", "half-written", "silent", "said otherwise", "good refused")
OUTCOMES = (*GOOD, *BAD)
"""answered: exit code 2 and one line, nothing written; warned, accepted: exit code 0, with a warning and without.

traceback: an exception that nobody caught, or death by a signal; hang: longer than allowed; over memory: more than allowed was
asked for; code run: the input's; half-written: a refusal that leaves something behind, or a temporary file; silent: exit code 0
though nothing was trained or measured, and no word of it; said otherwise: another exit code, or not one line; good refused: the
input was left as it is.
"""
MEMORY = re.compile(r"MemoryError|[Cc]an(no|')t allocate memory|bad_alloc|not enough memory")
TIMERS = (signal.SIGALRM, signal.SIGPROF, signal.SIGXCPU)
KEPT = ("rightsize", "stability")
"""Verbs that keep what is done where they stop, as sweeps and resumed runs do."""
LINE = re.compile(r'File "[^"]*?((?:nerf_lightning|benchmarks)/[^"]+)", line (\d+)')
CLEAN = "nerf_lightning.errors.InputError"


@dataclass(frozen=True)
class Verdict:
    """What became of a case, and where."""

    outcome: str
    cause: str
    """File, line and kind of an error, or what was said or left; cases of one cause are alike."""


def judge(ended: Ended, command: Command, limits: Limits, folder: Path, harmed: bool) -> Verdict:
    """What became of a case.

    Args:
        ended: how its process ended.
        command: what it ran.
        limits: what it was allowed.
        folder: where it ran, see `case.run`.
        harmed: whether its input was damaged.
    """
    outcome, cause = _outcome(ended, command, limits, folder)
    if not harmed and outcome not in ("accepted", "warned", *BAD):
        return Verdict("good refused", " ".join(ended.err.split())[:200])
    return Verdict(outcome, cause)


def _outcome(ended: Ended, command: Command, limits: Limits, folder: Path) -> tuple[str, str]:
    lines = [line for line in ended.err.splitlines() if line.strip()]
    answered = (ended.code == 2 and len(lines) == 1) or (ended.code == 1 and _jobs_failed(lines))
    if ended.marked:
        return "code run", _place(ended.err) or "a file was made"
    if -ended.code in TIMERS:
        return "hang", _place(ended.err, last=False) or "outside of this package"
    if ended.code == -signal.SIGKILL or ended.grown > limits.room:
        return "over memory", _place(ended.err) or f"{ended.grown / 1e9:.1f} GB"
    if not answered and MEMORY.search(ended.err):
        return "over memory", _place(ended.err) or _short(lines[-1])
    if ended.code < 0:
        return "traceback", f"died of {signal.Signals(-ended.code).name}; {_place(ended.err, last=False)}"
    if "Traceback (most recent call last)" in ended.err:
        return "traceback", f"{_place(ended.err)}: {_short(lines[-1])}"
    for name in ended.new:
        if Path(name).name == "error.txt" and not (text := (folder / name).read_text(encoding="utf-8")).split("\n")[
            -2
        ].startswith(CLEAN):
            return "traceback", f"a job of a sweep: {_place(text)}: {_short(text.splitlines()[-1])}"
    own = any(one in ("-m", "--multirun") or one.startswith("resume=") for one in command.arguments)
    if left := leftovers(ended, ended.code == 0 or own or command.verb in KEPT):
        return "half-written", f"exit {ended.code}, {command.verb}: {left}"
    if answered:
        return "answered", lines[-1]
    if ended.code == 0:
        warned = "warning" in (ended.out + ended.err).lower() or "guard:" in ended.out
        if not warned and (empty := _nothing_came(ended, folder)):
            return "silent", empty
        return ("warned" if warned else "accepted"), ""
    strange = [line for line in lines if not line.startswith("nerf_lightning: ")] or lines or ["nothing"]
    said = re.sub(r"^\S*/(?=nerf_lightning/|site-packages/)", "", strange[0]).split(": ")[0]
    return "said otherwise", f"exit {ended.code} and {'more than ' * (len(lines) > 1)}a line: {_short(said)}"


def _jobs_failed(lines: list[str]) -> bool:
    """Whether a sweep told each job that failed in a line, and then how many these were."""
    *jobs, last = lines or [""]
    found = re.match(r"nerf_lightning: (\d+) of \d+ jobs failed: ", last)
    return found is not None and len(jobs) == int(found[1]) and all(": failed: " in job for job in jobs)


def leftovers(ended: Ended, finished: bool) -> str:
    """What was left behind that should not be; "" for nothing.

    Args:
        ended: how the process ended.
        finished: whether it may leave whole files.
    """
    temporary = [name for name in ended.new if Path(name).name.startswith(".") or name.startswith("tmp/")]
    other = [] if finished else [*ended.new, *ended.lost]
    found = sorted({re.sub(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d", "TIME", name) for name in (*temporary, *other)})
    return ", ".join(name[:40] for name in found[:4])


def _nothing_came(ended: Ended, folder: Path) -> str:
    """How a run that ended well trained or measured nothing; "" where it did, or there was none."""
    for name in ended.new:
        if Path(name).name != "results.json":
            continue
        try:
            results = json.loads((folder / name).read_text(encoding="utf-8"))
        except ValueError:
            return "results.json is no JSON"
        psnr, steps = results.get("psnr"), results.get("steps")
        if results.get("status") == "finished" and not (isinstance(psnr, float) and math.isfinite(psnr)):
            return f"finished with a PSNR of {psnr}"
        if results.get("status") == "finished" and not steps:
            return f"finished after {steps} steps"
    return ""


def _place(text: str, last: bool = True) -> str:
    """The innermost line of this package in a traceback: the last of one, the first of what faulthandler writes."""
    found = LINE.findall(text)
    found = [one for one in found if one[0].startswith("nerf_lightning")]
    return ":".join(found[-1 if last else 0]) if found else ""


def _short(line: str) -> str:
    """The kind of an error without what differs from case to case."""
    return re.sub(r"[-+]?\d[\d.e+-]*", "N", line)[:100]
