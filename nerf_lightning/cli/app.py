"""nerf_lightning COMMAND: all commands in the order of the work, and errors in one line. Imports nothing heavy."""

import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from cyclopts import App, Parameter
from cyclopts.exceptions import CycloptsError

from nerf_lightning import __version__
from nerf_lightning.cli.evaluate import evaluate
from nerf_lightning.cli.train import is_override, train
from nerf_lightning.errors import InputError

TRACEBACK = "NERF_LIGHTNING_TRACEBACK"
"""Environment variable: set to 1, errors come with the full traceback."""

app = App(
    name="nerf_lightning",
    help="Turn photos into a radiance field, on the machine you have.",
    version=__version__,
    default_parameter=Parameter(negative=(), show_choices=False),
    print_error=False,
    exit_on_error=False,
    suppress_keyboard_interrupt=False,
    result_action="return_value",
)
for function in (train, evaluate):
    app.command(function, sort_key=len(app.resolved_commands()))


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a command line and exits: 0, 2 for bad input or a full disk, 130 after Ctrl-C, 143 after SIGTERM."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and is_override(words[0]):
        words.insert(0, "train")
    try:
        app(words)
    except CycloptsError as error:
        fail(InputError("command line", "", str(error).rstrip("."), "what --help lists"))
    except InputError as error:
        fail(error)


def fail(error: Exception) -> None:
    """Prints an error in one line, with its traceback if the environment asks for it, and exits with 2."""
    if os.environ.get(TRACEBACK) == "1":
        traceback.print_exception(error)
    print(f"nerf_lightning: {' '.join(str(error).split())} ({TRACEBACK}=1 shows the traceback)", file=sys.stderr)
    sys.exit(2)
