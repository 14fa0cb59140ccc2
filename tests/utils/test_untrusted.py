"""Text from outside is read within limits, or refused in one line."""

import os
from pathlib import Path

import pytest
import yaml

from nerf_lightning.errors import InputError
from nerf_lightning.utils import memory
from nerf_lightning.utils.parsing import DEEPEST, YAML_SIZE, read_json, read_yaml

NINES = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (NINES, "values, aliases written out"),
        (NINES.replace("[*", "{<<: [*").replace("*]", "*]").replace("]\n", "]}\n").replace("1]}", "1]"), "values"),
        ("a: &a [*a]", "stands in what it stands for"),
        ("a: *b", "undefined alias"),
        ("[" * 5000, f"more than {DEEPEST} levels"),
        ("- " * 5000 + "1", f"more than {DEEPEST} levels"),
        ("x" * (YAML_SIZE + 1), f"of at most {YAML_SIZE} bytes"),
        ("a: " + "9" * 400, "a whole number of 400 digits"),
        ("a: !!bool maybe", "no YAML"),
        ("a: !!int ''", "no YAML"),
        ("a: !!timestamp x", "no YAML"),
        ("a: 2001-99-99", "no YAML"),
        ("a: \udcff", "no YAML"),
        ("!!python/object/apply:os.getcwd []", "no YAML"),
    ],
)
def test_yaml_beyond_a_limit_is_refused(text: str, found: str, tmp_path: Path):
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(InputError, match=r"a\.yaml: found .*, expected options") as caught:
        read_yaml(tmp_path / "a.yaml", "options")
    assert found in str(caught.value) and "\n" not in str(caught.value)


def test_yaml_as_people_write_it_is_read(tmp_path: Path):
    text = (
        "base: &base {a: 1, b: [1.5, yes, null]}\nmore:\n- {<<: *base, a: 2}\n- *base\nday: 2020-01-02\nbig: 0xffff\n"
    )
    (tmp_path / "a.yaml").write_text(text)
    assert read_yaml(tmp_path / "a.yaml", "options") == yaml.safe_load(text)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("[" * 100_000, "levels"),
        ("[" * (DEEPEST + 1) + "]" * (DEEPEST + 1), "levels"),
        ('{"a": ' * 5000, "levels"),
        ("[" + "9" * 400 + "]", "a whole number of 400 digits"),
        ("[" + "9" * 5000 + "]", "a whole number of 5000 digits"),
        ("[1", "broken JSON at line 1, column 3"),
        ("", "broken JSON"),
        ('"\udcff"', "UnicodeDecodeError"),
    ],
)
def test_json_beyond_a_limit_is_refused(text: str, found: str, tmp_path: Path):
    (tmp_path / "a.json").write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(InputError, match=r"a\.json: found .*, expected figures; export it again") as caught:
        read_json(tmp_path / "a.json", "figures")
    assert found in str(caught.value)


def test_json_as_programs_write_it_is_read(tmp_path: Path):
    (tmp_path / "a.json").write_text("\ufeff" + "[" * DEEPEST + "18446744073709551616, 1e400, NaN" + "]" * DEEPEST)
    found = read_json(tmp_path / "a.json", "figures")
    for _ in range(DEEPEST):
        found, *rest = found
    assert found == 2**64 and rest[0] == float("inf")


def test_what_is_no_ordinary_file_is_refused_without_waiting_for_it(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    for name, found in (("pipe", "nothing there"), ("", "a folder"), ("x" * 5000, "no file's name")):
        with pytest.raises(InputError, match=f"found {found}"):
            read_json(tmp_path / name, "figures")


def test_a_file_whose_content_does_not_fit_into_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.json").write_text("[1, 2, 3]")
    monkeypatch.setattr(memory, "free_memory", lambda *_: 100.0)
    with pytest.raises(InputError, match=r"take at least .* GiB, expected at most the 0\.0 GiB that are free"):
        read_json(tmp_path / "a.json", "figures")


def test_some_memory_is_left():
    assert 0 < memory.free_memory() < 2**50
