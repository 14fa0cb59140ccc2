"""Published figures from YAML."""

import pytest
import yaml

from nerf_lightning.chart.references import Reference, matching, provenance, read_references
from nerf_lightning.chart.setting import Setting
from nerf_lightning.config import conf_dir
from nerf_lightning.errors import InputError

ENTRY = {
    "source": "a paper",
    "hardware": "a cluster",
    "scene": "Toy",
    "conditions": "800x800",
    "methods": {"theirs": [35.5, 120], "slower": [36, 9000.0]},
}


def test_entries_become_references_by_rising_time():
    setting = Setting("toy", "", "8x8", "", "", "")
    found = read_references({"one": ENTRY, "two": ENTRY | {"scene": "ship"}})
    assert len(found) == 4
    chosen = matching(reversed(found), setting)
    assert chosen[0] == Reference("theirs", 35.5, 120.0, "a paper", "a cluster", "Toy", "800x800")
    assert [one.name for one in chosen] == ["theirs", "slower"]
    (line,) = provenance(chosen)
    assert line == "Published, other hardware: theirs, slower: 800x800; a cluster; a paper."


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("35 dB", "references.one"),
        ({key: ENTRY[key] for key in ENTRY if key != "source"}, "references.one.source"),
        (ENTRY | {"colour": 1}, "references.one.colour"),
        (ENTRY | {"methods": {"a": 35.0}}, "references.one.methods"),
        (ENTRY | {"methods": {"a": [35.0, 0]}}, "references.one.methods.a"),
        (ENTRY | {"methods": {"a": [35.0, "2 min"]}}, "references.one.methods"),
        (ENTRY | {"methods": [35.0]}, "references.one.methods"),
    ],
)
def test_wrong_entries_are_named(entry: object, words: str):
    with pytest.raises(InputError, match=words):
        read_references({"one": entry})


@pytest.mark.parametrize("path", sorted((conf_dir() / "references").glob("*.yaml")), ids=lambda path: path.stem)
def test_what_is_shipped_can_be_read(path):
    found = read_references(yaml.safe_load(path.read_text()))
    assert found and all(one.source and one.hardware for one in found)
