from functools import partial
from pathlib import Path

import pytest
from capture.views import SIZE

from benchmarks.synthetic.photos import Truth
from nerf_lightning.capture.__main__ import task
from nerf_lightning.config import cli

main = partial(cli.run, "capture", task)


def test_one_command_makes_a_scene_with_its_report(verb, made: tuple[Path, Truth], tmp_path: Path):
    folder, _ = made
    given = [f"calibration={folder}/calibration", f"photos={folder}/photos", f"tags.size={SIZE}", "resize=120"]
    code, out, err = verb(main, *given, "output=mine/scene.npz")
    assert code == 0, err
    assert "of 8 photos placed" in out and "+experiment=capture dataset.path=mine/scene.npz" in out
    written = sorted(str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*") if file.is_file())
    report = [f"mine/scene_report/{name}.png" for name in ("cameras", "coverage", "errors", "tags")]
    assert written == ["mine/calibration.yaml", "mine/cameras.json", "mine/scene.npz", *report]


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
        (["calibration=a", "photos=b", "tags.size=0.02", "tags.layout=charuco"], "tags.board.columns: found nothing"),
        (["holdout=1"], "holdout: found 1"),
    ],
)
def test_bad_input_is_one_line(verb, arguments: list[str], words: str, tmp_path: Path):
    code, _, err = verb(main, *arguments)
    assert code == 2
    assert err.count("\n") == 1 and words in err, err
    assert tmp_path.is_dir() and not list(tmp_path.iterdir())
