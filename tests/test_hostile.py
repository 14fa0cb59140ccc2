"""Hostile inputs end in a line. The first tests are about the judge: each kind of misbehaviour must be found."""

import json
import os
import subprocess
import sys
from pathlib import Path
from random import Random

import pytest

from benchmarks import __main__ as command

if not hasattr(os, "fork"):
    pytest.skip("cases are forked", allow_module_level=True)

from benchmarks.hostile import damage, trees
from benchmarks.hostile.kinds import KINDS, Case
from benchmarks.hostile.verdict import BAD

ROOT = Path(__file__).resolve().parents[1]
CASES = (60, pytest.param(400, marks=pytest.mark.long))
"""Fifteen seconds of one core, and two minutes; `python -m benchmarks hostile` runs thousands."""
OUTCOMES = {
    "raises": "traceback",
    "dies": "traceback",
    "a job raises": "traceback",
    "works without end": "hang",
    "waits without end": "hang",
    "asks for memory": "over memory",
    "takes memory": "over memory",
    "runs code": "code run",
    "runs code and refuses": "code run",
    "refuses and leaves a folder": "half-written",
    "refuses and changes a file": "half-written",
    "refuses and removes a file": "half-written",
    "leaves a temporary file": "half-written",
    "trains nothing": "silent",
    "measures nothing": "silent",
    "refuses in two lines": "said otherwise",
    "refuses without a word": "said otherwise",
    "fails with another code": "said otherwise",
    "a job fails and is not named": "said otherwise",
    "refuses": "answered",
    "jobs refuse": "answered",
    "warns": "warned",
    "trains": "accepted",
    "a job refuses": "accepted",
    "works": "accepted",
}


def process(*arguments: str, cwd: Path) -> str:
    """What a Python of its own prints: nothing that tests have computed may be in a process that forks."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
        "OMP_NUM_THREADS": "1",
    }
    words = [sys.executable, "-m", *arguments]
    done = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_what_a_command_does_is_what_the_table_says(tmp_path: Path):
    """By behaviour: what the judge says of it where the input was damaged, and where it was not."""
    judged = json.loads(process("misbehaving", *OUTCOMES, cwd=tmp_path))
    assert judged == {how: [found, "good refused" if found == "answered" else found] for how, found in OUTCOMES.items()}


@pytest.mark.parametrize("cases", CASES)
def test_hostile_inputs_end_in_a_line(cases: int, tmp_path: Path):
    """The number of cases is their seed too: the longer run repeats none of the shorter."""
    process("benchmarks", "hostile", "--seeds", str(cases), "--cases", str(cases), "--output", "found", cwd=tmp_path)
    found = json.loads((tmp_path / "found" / "benchmarks.json").read_text())
    assert [row for row in found["hostile causes"] if row["outcome"] in BAD] == []
    *rows, whole = found["hostile"]
    assert whole["tried"] == sum(row["tried"] for row in rows) == cases
    assert whole["answered"] > whole["accepted"] > 0, "damage is noticed, and what does no harm is taken"
    for row in found["hostile"]:
        assert sum(row[key] for key in row if key not in ("kind", "tried")) == row["tried"]


def test_a_case_follows_from_its_seed_and_number():
    first, again, other = ([Case(seed, number).kind.name for number in range(400)] for seed in (1, 1, 2))
    assert first == again != other
    assert set(first) == {kind.name for kind in KINDS}


def test_documents_hold_what_no_writer_would_write(tmp_path: Path):
    good = json.dumps({"a": {"b": [1.0, 2.0], "c": "text"}, "d": None})
    texts = [trees.damaged(good, Random(i), tmp_path / "marker", as_json=i % 2 == 0)[0] for i in range(600)]
    assert any("[" * 1000 in text for text in texts), "deep nesting"
    assert any("NaN" in text for text in texts) and any("Infinity" in text for text in texts)
    assert any(text.count('"a":') == 2 or text.count('"b":') == 2 for text in texts), "a key that stands twice"
    assert any("*a7" in text for text in texts), "aliases that multiply"
    assert any("os.system" in text for text in texts)
    assert not any(trees.AGAIN in text or "RAW0" in text for text in texts), "what stood for these is gone"


def test_bytes_are_changed_but_rarely_all_of_them():
    good = bytes(range(256)) * 4
    found = [damage.as_bytes(good, Random(i))[0] for i in range(300)]
    assert sum(one != good for one in found) > 280 and sum(len(one) == len(good) for one in found) > 100


def test_the_part_runs_only_when_it_is_named():
    assert "hostile" in command.ALONE and "hostile" not in command.PARTS


def test_a_system_without_fork_is_told_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.delattr(os, "fork")
    monkeypatch.setattr("sys.argv", ["benchmarks", "hostile"])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    assert stopped.value.code == 2 and "fork" in capsys.readouterr().err
