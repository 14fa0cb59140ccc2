"""The command line as a whole: help, suggestions, exit codes."""

import subprocess
import sys
from pathlib import Path

import pytest

from nerf_lightning.cli.app import app, find_input_error

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = [name for name in app.resolved_commands() if not name.startswith("-")]


def test_help_does_not_import_torch():
    probe = "import sys; from nerf_lightning.cli.app import app\n"
    probe += f"for name in {COMMANDS}: \n  app([name, '--help'])\n"
    probe += "print(sorted({'torch', 'lightning', 'cv2', 'hydra', 'pandas', 'scipy', 'numpy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", probe], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.endswith("[]\n"), done.stdout[-200:] + done.stderr


def test_help_of_each_command_fits_screen(run_cli, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "100")
    for name in COMMANDS:
        code, out, err = run_cli(name, "--help")
        assert (code, err) == (0, "") and out.startswith(f"Usage: nerf_lightning {name}")
        assert len(out.splitlines()) <= 45


def test_help_lists_commands_in_workflow_order_and_quick_start(run_cli):
    code, out, _ = run_cli()
    assert code == 0 and "export mesh -o mesh.glb" in out
    places = [out.index(f" {name} ") for name in COMMANDS]
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["evalute"], 'Did you mean "evaluate"?'),
        (["evaluate", "--worts", "3"], "Did you mean --worst?"),
        (["evaluate", "--worst", "x"], "--worst"),
        (["evaluate", "--worst", "0"], "worst: found 0, expected a whole number at least 1"),
        (["evaluate", "--split", "all"], "val"),
        (["evaluate", "nowhere (1), ü=2"], "nowhere (1), ü=2: no such file or folder"),
        (["evaluate"], "outputs: no such file or folder"),
    ],
)
def test_main_wrong_arguments_exit_with_code_2(arguments: list[str], words: str, run_cli):
    code, _, err = run_cli(*arguments)
    assert code == 2 and err.count("\n") == 1 and words in err


def test_find_input_error_mismatched_torchvision_gives_hint():
    found = find_input_error(RuntimeError("operator torchvision::nms does not exist"))
    assert "pip install --force-reinstall --no-deps torchvision" in str(found)
