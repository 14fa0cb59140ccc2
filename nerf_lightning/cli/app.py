"""The nerf_lightning command: all commands in workflow order, and one-line errors. Fast to import."""

import inspect
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Any, NoReturn

from cyclopts import App, Parameter
from cyclopts.exceptions import CycloptsError

from nerf_lightning import __version__
from nerf_lightning.cli.capture import capture, print_tags
from nerf_lightning.cli.check import check
from nerf_lightning.cli.compare import compare
from nerf_lightning.cli.evaluate import evaluate
from nerf_lightning.cli.export import export
from nerf_lightning.cli.render import render
from nerf_lightning.cli.rightsize import rightsize
from nerf_lightning.cli.stability import stability
from nerf_lightning.cli.train import describe_groups, is_override, train
from nerf_lightning.cli.view import view
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import disk_full_error, is_disk_full
from nerf_lightning.utils.libraries import limit_openmp_spinning
from nerf_lightning.utils.signals import exit_on_signal

TRACEBACK_VARIABLE = "NERF_LIGHTNING_TRACEBACK"
"""Environment variable: 1 prints full tracebacks."""

QUICK_START = """From a folder of photos to a page to send, and a mesh:

    nerf_lightning train dataset=photos dataset.path=PHOTOS
    nerf_lightning export html -o page.html
    nerf_lightning export mesh -o mesh.glb

nerf_lightning COMMAND --help explains each command."""

app = App(
    name="nerf_lightning",
    help="Turn photos into a radiance field, on the machine you have.",
    help_epilogue=QUICK_START,
    version=__version__,
    default_parameter=Parameter(negative=(), show_choices=False),
    print_error=False,
    exit_on_error=False,
    suppress_keyboard_interrupt=False,
    result_action="return_value",
)
_help = f"{inspect.cleandoc(train.__doc__ or '')}\n{describe_groups()}"
_commands: tuple[Any, ...] = (
    *(print_tags, capture, check, train, view, render),
    *(evaluate, export, compare, rightsize, stability),
)
for _command in _commands:
    if _command is train:
        app.command(train, help=_help, help_format="plaintext", usage="Usage: nerf_lightning train KEY=VALUE...\n")
    else:
        app.command(_command)
for _number, _name in enumerate(app.resolved_commands()):
    app[_name].sort_key = _number
    app[_name].help_epilogue = ""  # not that of the front page
app.register_install_completion_command()
for _name in ("--help", "--version", "--install-completion"):
    app[_name].group = "Options"


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a command line; exits with 2 on bad input or a full disk, 130 after Ctrl-C and 143 after SIGTERM.

    Errors that the user can fix are printed in one line; all others are defects and keep their traceback.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and is_override(words[0]):
        words.insert(0, "train")
    limit_openmp_spinning()
    try:
        with exit_on_signal():
            app(words)
    except CycloptsError as error:
        exit_with_error(error)
    except Exception as error:
        if (known := find_input_error(error)) is None:
            raise
        exit_with_error(known)


def find_input_error(error: Exception) -> InputError | None:
    """Converts an error that the user can fix (bad input, file access, a mismatched torchvision, out of memory) to an
    InputError; None for a defect."""
    if isinstance(error, InputError):
        return error
    if is_disk_full(error):
        return disk_full_error(getattr(error, "filename", None) or os.getcwd())
    if isinstance(error, OSError) and error.filename:
        return InputError(error.filename, "", str(error.strerror), hint="check the path and its permissions")
    if "torchvision::" in str(error):  # imported by torchmetrics, a dependency of Lightning
        hint = "pip install --force-reinstall --no-deps torchvision, from the package index that PyTorch came from"
        return InputError("torchvision", "", f"not built for this PyTorch ({error})", hint=hint)
    if isinstance(error, MemoryError | RuntimeError):
        from nerf_lightning.utils.memory import out_of_memory_error

        return out_of_memory_error(error)
    return None


def exit_with_error(error: Exception) -> NoReturn:
    """Prints an error in one line, after its traceback if `TRACEBACK_VARIABLE` is 1, and exits with 2."""
    if os.environ.get(TRACEBACK_VARIABLE) == "1":
        traceback.print_exception(error)
    message = " ".join(str(error).split())
    print(f"nerf_lightning: {message} ({TRACEBACK_VARIABLE}=1 shows the traceback)", file=sys.stderr)
    sys.exit(2)
