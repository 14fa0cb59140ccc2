from pathlib import Path

from nerf_lightning.utils.html import address_from, script_data


def test_script_data_cannot_end_its_element():
    assert "</script>" not in script_data({"a": "</script>"})


def test_address_from_quotes_names():
    assert address_from(Path("a/b"), Path("a/c d/ü.html")) == "../c%20d/%C3%BC.html"
