from functools import partial
from pathlib import Path

import pytest
from capture.views import SIZE

from nerf_lightning.capture.__main__ import task
from nerf_lightning.capture.outputs import Packing
from nerf_lightning.capture.run import Capture
from nerf_lightning.config import cli

main = partial(cli.run, "capture", task)


def test_one_command_makes_a_scene_with_its_report(verb, packed: tuple[Path, Capture], monkeypatch: pytest.MonkeyPatch):
    """What it writes is tested with `capture` and `write_report`, and the command in docs/ runs whole."""
    given, reports = [], []
    monkeypatch.setattr("nerf_lightning.capture.run.capture", lambda *options: given.append(options) or packed[1])
    monkeypatch.setattr("nerf_lightning.capture.report.write.write_report", lambda *options: reports.append(options))
    code, out, err = verb(
        main, "calibration=sheet", "photos=object", f"tags.size={SIZE}", "resize=120", "output=mine/scene.npz"
    )
    assert code == 0, err
    packing = Packing(Path("mine/scene.npz"), longest=120)
    assert given == [(Path("sheet"), Path("object"), SIZE, packing, "auto", "auto", None)]
    assert reports == [(packed[1], Path("mine/scene_report"))]
    placed = sum(photo.status == "placed" for photo in packed[1].photos)
    assert placed >= 7  # detectors find one more or less on other processors
    assert f"{placed} of 8 photos placed" in out and "+experiment=capture dataset.path=mine/scene.npz" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "calibration: found nothing, expected a value; give calibration=FOLDER"),
        (["calibration=a", "photos=b"], "tags.size: found nothing, expected a value; give tags.size=0.06"),
        (["poses=guess"], "poses: found guess, expected tags or colmap"),
        (["poses=colmap"], "photos: found nothing"),
        (["poses=colmap", "photos=nowhere"], "photos: found nowhere, which is no folder"),
        (["tags.sise=0.06"], "found tags.sise"),
        (["tags.size=large"], "tags.size: found 'large', expected"),
        (["tags.size=nan"], "tags.size: found nan, expected a finite number"),
        (["calibration=a", "photos=b", "tags.size=0.02", "tags.layout=charuco"], "tags.board.columns: found nothing"),
        (["holdout=1"], "holdout: found 1"),
    ],
)
def test_bad_input_is_one_line(verb, arguments: list[str], words: str, tmp_path: Path):
    code, _, err = verb(main, *arguments)
    assert code == 2
    assert err.count("\n") == 1 and words in err, err
    assert tmp_path.is_dir() and not list(tmp_path.iterdir())
