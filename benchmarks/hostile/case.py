"""One case: a command line in a process of its own, forked from this one, with limits of memory and time."""

import faulthandler
import json
import os
import resource
import runpy
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import psutil

SHARED = 4
"""Times as much of the clock as of the processor: on a machine that others use too, and for what waits instead of working."""


@dataclass(frozen=True)
class Limits:
    """What a process may use, beyond what this one does."""

    seconds: float
    """Of the processor."""
    room: int
    """Bytes."""


@dataclass(frozen=True)
class Command:
    """A command line."""

    module: str
    """What stands behind `python -m`."""
    arguments: tuple[str, ...]
    good: bool = False
    """Whether nothing is wrong with it, only with what it reads: then it is composed once, for speed. Hydra otherwise composes
    it before, to see whether its configuration says that it is a sweep."""

    @property
    def verb(self) -> str:
        return self.module.removeprefix("nerf_lightning").lstrip(".") or "train"


@dataclass(frozen=True)
class Ended:
    """How a process ended."""

    code: int
    """Its exit code; minus the number of the signal it died of."""
    out: str
    err: str
    seconds: float
    """Of the processor."""
    grown: int
    """Bytes, at most, beyond those when its input was written."""
    new: tuple[str, ...]
    """What is in the folder that was not there before, and what has changed."""
    lost: tuple[str, ...]
    """What is not there any more."""
    marked: bool
    """Whether code of the input ran."""
    modules: tuple[str, ...]
    """What it had imported."""


def run(prepare: Callable[[Path, Path], Command], folder: Path, limits: Limits | None) -> Ended:
    """Runs a command line in a process of its own.

    Args:
        prepare: writes the input into the folder `work` it is given, and names the command line; the second path is the
            marker, which code in the input would create. It runs in the new process, before the limits count.
        folder: empty; gets `work`, where the command runs, and what it says.
        limits: None: none but the machine's.

    Raises:
        RuntimeError: where `prepare` fails, which is a defect of the benchmark.
    """
    said, work = folder / "said", folder / "work"
    for one in (said, work, folder / "tmp"):
        one.mkdir(parents=True)
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        _child(prepare, folder, limits)
    _, status, used = os.wait4(pid, 0)
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)  # what it has started and left behind
    if (said / "unmade").exists():
        raise RuntimeError((said / "unmade").read_text(encoding="utf-8"))
    there = dict(_listed(folder))
    earlier, taken, seconds = json.loads((said / "before").read_text(encoding="utf-8"))
    return Ended(
        os.waitstatus_to_exitcode(status),
        (said / "out").read_text(encoding="utf-8", errors="replace"),
        (said / "err").read_text(encoding="utf-8", errors="replace"),
        used.ru_utime + used.ru_stime - seconds,
        used.ru_maxrss * 1024 - taken,
        tuple(sorted(name for name in there if there[name] != earlier.get(name))),
        tuple(sorted(name for name in earlier if name not in there)),
        (folder / "marker").exists(),
        tuple((said / "modules").read_text(encoding="utf-8").split()) if (said / "modules").exists() else (),
    )


def _listed(folder: Path) -> list[tuple[str, str]]:
    """Every file and folder below but what the process said, with what tells that it has changed."""
    found = []
    for at, folders, files in os.walk(folder):
        if Path(at) == folder:
            folders.remove("said")
            files = [name for name in files if name != "marker"]
        for name in (*folders, *files):
            path = os.path.join(at, name)
            about = os.lstat(path)
            state = "folder" if name in folders else f"{about.st_size} {about.st_mtime_ns}"
            found.append((os.path.relpath(path, folder).encode("utf-8", "backslashreplace").decode(), state))
    return found


def _child(prepare: Callable[[Path, Path], Command], folder: Path, limits: Limits | None) -> NoReturn:
    """The new process: never returns."""
    try:
        os.setsid()
        command = prepare(folder / "work", folder / "marker")
        before = dict(_listed(folder)), psutil.Process().memory_info().rss, time.process_time()
        (folder / "said" / "before").write_text(json.dumps(before), encoding="utf-8")
        _enter(folder)
        _limit(limits)
    except BaseException:  # noqa: BLE001  (the process that waits raises it)
        (folder / "said" / "unmade").write_text(traceback.format_exc(), encoding="utf-8")
        os._exit(1)
    code = 1
    try:
        code = _main(command)
        if limits is None:
            (folder / "said" / "modules").write_text("\n".join(sys.modules), encoding="utf-8")
    finally:
        os._exit(code)


def _enter(folder: Path) -> None:
    """The process works in the folder, and says there what it says."""
    for number, name in ((1, "out"), (2, "err")):
        opened = os.open(folder / "said" / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(opened, number)
        os.close(opened)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", errors="backslashreplace", closefd=False)
    sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False, buffering=1)
    tempfile.tempdir = str(folder / "tmp")
    os.environ["TMPDIR"] = tempfile.tempdir
    os.chdir(folder / "work")


def _limit(limits: Limits | None) -> None:
    """Sets the limits; the package sees a machine with as much memory as the process may take."""
    for one in (signal.SIGALRM, signal.SIGPROF, signal.SIGTERM):
        signal.signal(one, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if limits is None:
        return
    faulthandler.register(signal.SIGPROF, chain=True)
    faulthandler.register(signal.SIGALRM, chain=True)
    signal.setitimer(signal.ITIMER_PROF, limits.seconds)
    signal.setitimer(signal.ITIMER_REAL, SHARED * limits.seconds)
    for what, most in ((resource.RLIMIT_DATA, _data() + limits.room), (resource.RLIMIT_FSIZE, limits.room)):
        resource.setrlimit(what, (most, resource.getrlimit(what)[1]))
    machine, own = psutil.virtual_memory()._replace(total=limits.room), psutil.Process()
    before = own.memory_info().rss

    def memory() -> Any:
        left = max(0, limits.room - (own.memory_info().rss - before))
        return machine._replace(available=left, free=left)

    psutil.virtual_memory = memory


def _data() -> int:
    """Bytes of memory of this process that RLIMIT_DATA counts."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmData:"):
            return int(line.split()[1]) * 1024
    return psutil.Process().memory_info().vms


def _main(command: Command) -> int:
    """Runs the command line as `python -m` would, to its exit code."""
    sys.argv = [command.module, *command.arguments]
    if command.good:
        from hydra._internal.hydra import Hydra

        Hydra.get_mode = lambda *_, **__: None  # type: ignore[method-assign]
    try:
        runpy.run_module(command.module, run_name="__main__", alter_sys=True)
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:  # noqa: BLE001  (as Python itself does)
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))  # to tell of it takes memory too
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return code
