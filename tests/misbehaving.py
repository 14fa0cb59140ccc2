"""A command line that behaves as it is told, and a program that has benchmarks/hostile judge it."""

import json
import os
import signal
import sys
import tempfile
import time
import warnings
from pathlib import Path


def behave(how: str) -> None:
    """Does one thing that a command line may do, or should not."""
    work = Path.cwd()
    match how:
        case "raises":
            raise ValueError("nobody caught this")
        case "dies":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "works without end":
            while True:
                pass
        case "waits without end":
            time.sleep(1000)
        case "asks for memory":
            bytearray(10**10)
        case "takes memory":
            rows = []
            while True:
                rows.append(bytes([1]) * 10**6)
        case "runs code":
            (work.parent / "marker").touch()
        case "runs code and refuses":
            (work.parent / "marker").touch()
            refuse()
        case "refuses and leaves a folder":
            (work / "outputs").mkdir()
            refuse()
        case "refuses and changes a file":
            (work / "input").write_text("other", encoding="utf-8")
            refuse()
        case "refuses and removes a file":
            (work / "input").unlink()
            refuse()
        case "leaves a temporary file":
            (work / ".result-x").touch()
        case "refuses in two lines":
            print("first", file=sys.stderr)
            refuse()
        case "refuses without a word":
            sys.exit(2)
        case "fails with another code":
            print("no", file=sys.stderr)
            sys.exit(1)
        case "refuses":
            refuse()
        case "warns":
            warnings.warn("odd", stacklevel=1)
        case "trains nothing":
            (work / "results.json").write_text(json.dumps({"status": "finished", "psnr": 9.0, "steps": 0}))
        case "measures nothing":
            (work / "results.json").write_text(json.dumps({"status": "finished", "psnr": None, "steps": 3}))
        case "trains":
            (work / "results.json").write_text(json.dumps({"status": "finished", "psnr": 9.0, "steps": 3}))
        case "a job raises":
            (work / "error.txt").write_text(
                "Traceback (most recent call last):\n  ...\nValueError: nobody caught this\n"
            )
        case "jobs refuse":
            print("size=a: failed: config: no\nsize=b: failed: config: no", file=sys.stderr)
            sys.exit("nerf_lightning: 2 of 2 jobs failed: size=a, size=b")
        case "a job fails and is not named":
            sys.exit("nerf_lightning: 1 of 2 jobs failed: size=a")
        case "a job refuses":
            (work / "error.txt").write_text("Traceback ...\nnerf_lightning.errors.InputError: no\n")
        case "works":
            print("done")


def refuse() -> None:
    print("nerf_lightning: input: found one thing, expected another", file=sys.stderr)
    sys.exit(2)


def main() -> None:
    """Runs each of the behaviours that are named in a process of its own, and prints what became of them, as JSON."""
    from benchmarks.hostile.case import Command, Limits, run
    from benchmarks.hostile.verdict import judge

    found = {}
    for how in sys.argv[1:]:
        # Only what never ends waits for its time to run out: the others must not meet it on a slow machine.
        limits = Limits(seconds=0.3 if how.endswith("without end") else 30.0, room=200_000_000)
        with tempfile.TemporaryDirectory() as folder:
            command = Command("misbehaving", ("as told", how))

            def prepare(work: Path, marker: Path, command: Command = command) -> Command:
                (work / "input").write_text("good", encoding="utf-8")
                return command

            place = Path(folder) / "case"
            ended = run(prepare, place, limits)
            whole = [judge(ended, command, limits, place, harmed) for harmed in (True, False)]
            found[how] = [verdict.outcome for verdict in whole]
    print(json.dumps(found))


if __name__ == "__main__":
    if sys.argv[1] == "as told":
        behave(sys.argv[2])
    else:
        main()
