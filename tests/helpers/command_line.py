"""The command line in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BARE = ["callbacks.pictures=null", "callbacks.upscale=null"]


def start_cli(*arguments: str, cwd: Path, python: str = sys.executable, path: str = str(ROOT)) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": path}
    environment.pop("NERF_LIGHTNING_TRACEBACK", None)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([python, "-m", "nerf_lightning", *arguments], cwd=cwd, env=environment, **pipes)


def run_process(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    process = start_cli(*arguments, cwd=cwd)
    out, err = process.communicate(timeout=120)
    return subprocess.CompletedProcess(arguments, process.returncode, out, err)
