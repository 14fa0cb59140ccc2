"""A field as a web page: what it draws in a browser against our own rendering, and what a stranger's names can do in it."""

import base64
import hashlib
import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from nerf_lightning.cameras import Cameras, make_circle_poses
from nerf_lightning.config.build import build_system
from nerf_lightning.config.compose import compose_config
from nerf_lightning.export.bake import bake_voxels
from nerf_lightning.export.web_page import SCRIPTS, render_field_page, render_gallery_page, render_image_page
from nerf_lightning.runs.compact import decode_run, encode_system, strip_local_paths
from nerf_lightning.runs.folder import LoadedRun, config_to_dict
from nerf_lightning.runs.scene_file import parse_metadata
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.html import read_minified, relative_url

HOSTILE = "</script><img src=x onerror=\"document.title='run'\">'\""
SIDE = 24


def scene_of(unbounded: bool) -> dict[str, Any]:
    K = [[30.0, 0, 12], [0, 30, 12], [0, 0, 1]]
    c2w = make_circle_poses(torch.zeros(3), torch.tensor([0.0, 0, 1]), 3.0, 0.5, 4)
    return {
        "format": 1, "name": "made", "source": "/home/somebody/photos", "background": [0.1, 0.2, 0.3],
        "aabb": [[-1.0, -0.8, -0.6], [1.0, 0.8, 0.6]], "unbounded": unbounded, "near": None, "far": None, "pixel": None,
        "to_source": torch.eye(4).tolist(),
        "orbit": {"K": [K] * 4, "c2w": c2w.tolist(), "width": SIDE, "height": SIDE},
    }  # fmt: skip


def made(recipe: str, precision: str = "byte", unbounded: bool = False) -> bytes:
    """A compact file of a field of random numbers, with some of its cells empty."""
    torch.manual_seed(0)
    cfg = compose_config(
        [f"recipe={recipe}_small", "sampler=occupancy", "sampler.resolution=16", "sampler.samples=48"], Path("unused")
    )
    scene = scene_of(unbounded)
    system = build_system(cfg, parse_metadata(scene, "made")[0])
    assert isinstance(system, NeRF3D)
    with torch.no_grad():
        for parameter in system.field.parameters():
            parameter.add_(torch.randn_like(parameter) * (0.3 if recipe == "tensorf" else 0.5))
    system.sampler.import_state({"grid.occupied": torch.rand(16**3) < 0.3})
    plain = config_to_dict(cfg)
    plain["dataset"]["path"] = "/home/somebody/photos"
    return strip_local_paths(encode_system(system, precision, plain, scene))


def page_of(compact: bytes, name: str = "made") -> tuple[str, LoadedRun]:
    run = decode_run(compact, "made")
    assert isinstance(run.system, NeRF3D) and run.orbit is not None
    poster = np.zeros((4, 4, 3), np.uint8)
    return render_field_page(compact, run.system, run.orbit, name, [("note", name)], run.orbit, [name] * 4, poster), run


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium here")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        options += ["--disable-background-networking"]
        opened = playwright.chromium.launch(executable_path=chromium, args=options)
        yield opened
        opened.close()


def opened(browser: Any, text: str, folder: Path, side: int = 320) -> tuple[Any, list[str]]:
    """The page from disk, and a list of whatever it asks for or complains of."""
    (folder / "field.html").write_text(text, encoding="utf-8")
    page, wrong = browser.new_page(viewport={"width": side, "height": side}, reduced_motion="reduce"), []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    page.on("request", lambda asked: wrong.append(asked.url) if not asked.url.startswith(("file:", "blob:")) else None)
    page.goto((folder / "field.html").as_uri())
    page.wait_for_selector("#view[data-drawn=fine]", timeout=60_000)
    return page, wrong


def seen_through(page: Any, cameras: Cameras, view: int) -> np.ndarray:
    K, (width, height) = cameras.K[view].tolist(), cameras.size(view)
    lens = [width, height, K[0][0], K[1][1], K[0][2], K[1][2]]
    show = "async ([rows, lens, size]) => { await field.show({rows, lens}, size); field.renderer.present(); "
    url = page.evaluate(
        show + "return field.canvas.toDataURL(); }", [cameras.c2w[view, :3].flatten().tolist(), lens, [width, height]]
    )
    return imageio.imread(base64.b64decode(url.split(",")[1]), extension=".png")[..., :3] / 255


@pytest.mark.parametrize(
    ("recipe", "precision", "unbounded"),
    [("tensorf", "half", True), ("voxels", "byte", False), ("hashgrid", "coarse", True)],
)
def test_render_field_page_matches_renderer(recipe: str, precision: str, unbounded: bool, browser: Any, tmp_path: Path):
    text, run = page_of(made(recipe, precision, unbounded))
    page, wrong = opened(browser, text, tmp_path, side=100)
    assert isinstance(run.system, NeRF3D) and run.orbit is not None
    for view in range(2):
        with torch.no_grad():
            expected = run.system.render(run.orbit.generate_view_rays(view)).rgb.view(SIDE, SIDE, 3).clamp(0, 1).numpy()
        assert expected.std() > 0.01, "something is seen"
        error = np.square(seen_through(page, run.orbit, view) - expected).mean()
        # Where a hash grid's faint samples take their neighbor's color, random fields show it most.
        assert -10 * np.log10(error) > (37 if recipe == "hashgrid" else 50)
    assert not wrong
    page.close()


def test_render_field_page_handles_input_and_lost_context(browser: Any, tmp_path: Path):
    page, wrong = opened(browser, page_of(made("voxels"))[0], tmp_path)
    look = "() => { field.renderer.present(); return [JSON.stringify(field.camera), field.canvas.toDataURL()]; }"
    assert page.evaluate("field.turning") is False, "who wants less motion gets no turntable"
    hint = page.locator("#hint")
    assert hint.is_visible() and "gone" not in (hint.get_attribute("class") or "")
    first = page.evaluate(look)
    background, coarse = "document.getElementById('view').style.background", "field.renderer.coarse"
    assert "image/jpeg" in page.evaluate(background) and page.evaluate(coarse) is None, (
        "the fine picture covers the poster"
    )

    def drag() -> None:
        page.mouse.down()
        page.mouse.move(180, 130, steps=2)
        page.mouse.up()

    for act, moves in (
        (drag, True),
        (lambda: page.keyboard.press("ArrowLeft"), True),
        (lambda: page.mouse.wheel(0, -200), True),
        (lambda: page.set_viewport_size({"width": 280, "height": 340}), False),
    ):
        page.mouse.move(160, 120)
        act()
        page.wait_for_timeout(200)
        page.wait_for_selector("#view[data-drawn=fine]", timeout=60_000)
        changed = page.evaluate(look)
        assert changed[1] != first[1]
        assert (changed[0] != first[0]) == moves
        first = changed
    assert hint.get_attribute("class") == "gone", "after the first drag"
    assert page.evaluate(background) == "none"
    lose = "() => { window.lost = field.renderer.gl.getExtension('WEBGL_lose_context'); lost.loseContext(); }"
    page.evaluate(lose)
    page.wait_for_selector("#view[data-drawn=lost]")
    page.evaluate("() => lost.restoreContext()")
    page.wait_for_selector("#view[data-drawn=fine]", timeout=60_000)
    assert page.evaluate(look) == first, "the same picture after the context came back"
    assert not wrong
    page.close()


@pytest.mark.long  # a software rasterizer draws for seconds
def test_render_field_page_settings_crop_and_close_on_escape(browser: Any, tmp_path: Path):
    page, wrong = opened(browser, page_of(made("voxels"))[0], tmp_path)
    page.click("#settings")
    page.keyboard.press("Escape")
    assert not page.locator("#panel").is_visible()
    page.click("#settings")
    page.locator(".crop").nth(3).fill("0.25")  # y to
    assert page.evaluate("field.renderer.look.keep") == [0, 0, 0, 1, 0.25, 1]
    page.click("#uncrop")
    assert page.evaluate("field.renderer.look.keep") == [0, 0, 0, 1, 1, 1]
    assert not wrong
    page.close()


@pytest.mark.long  # a software rasterizer draws for seconds
def test_render_field_page_touch_zooms_and_rotates(browser: Any, tmp_path: Path):
    (tmp_path / "field.html").write_text(page_of(made("voxels"))[0], encoding="utf-8")
    telephone = browser.new_context(viewport={"width": 320, "height": 480}, has_touch=True, is_mobile=True)
    page = telephone.new_page()
    page.goto((tmp_path / "field.html").as_uri())
    page.wait_for_selector("#view[data-drawn]", timeout=60_000)
    send = telephone.new_cdp_session(page).send

    def drag(*fingers: tuple[int, int, int, int]) -> list[float]:
        for kind, share in (("touchStart", 0.0), ("touchMove", 0.5), ("touchMove", 1.0)):
            places = [(x + share * (u - x), y + share * (v - y)) for x, y, u, v in fingers]
            points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
            send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        page.wait_for_timeout(100)
        assert page.evaluate("[scrollY, visualViewport.scale]") == [0, 1], "the page itself stays"
        return page.evaluate("[field.camera.distance, ...field.camera.target]")

    distance, *target = drag((120, 150, 120, 150))
    assert page.evaluate("field.turning") is False, "a touch stops the turntable"
    before = page.evaluate("field.camera.eye")
    assert drag((120, 150, 200, 180)) == pytest.approx([distance, *target])
    assert page.evaluate("field.camera.eye") != before
    closer, *moved = drag((100, 150, 50, 180), (140, 150, 190, 180))
    assert closer < 0.8 * distance and moved != target
    telephone.close()


@pytest.mark.long  # a software rasterizer draws for seconds
def test_render_gallery_page_cameras_are_synchronized(browser: Any, tmp_path: Path):
    names = ["a=1,b", "c"]
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "field.html").write_text(page_of(made("voxels"), name)[0], encoding="utf-8")
    pages = [(relative_url(tmp_path, tmp_path / name / "field.html"), name, "20 dB") for name in names]
    (tmp_path / "gallery.html").write_text(render_gallery_page("made", pages), encoding="utf-8")
    page = browser.new_page(viewport={"width": 720, "height": 420})
    page.goto((tmp_path / "gallery.html").as_uri())
    frames = page.frames[1:]
    assert len(frames) == 2
    for frame in frames:
        frame.wait_for_selector("#view[data-drawn=fine]", timeout=60_000)
    box = page.locator("iframe").first.bounding_box()
    page.mouse.move(box["x"] + 50, box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 90, box["y"] + 60)
    page.mouse.up()
    page.wait_for_timeout(300)
    for frame in frames:
        frame.wait_for_selector("#view[data-drawn=fine]", timeout=60_000)
    eyes = [frame.evaluate("field.camera.eye") for frame in frames]
    assert eyes[0] == eyes[1] != frames[0].evaluate("field.orbit[0].eye")
    assert [frame.evaluate("field.frame") for frame in frames] == [None, None], "at rest nothing is asked for"
    page.close()


def test_render_field_page_escapes_names(browser: Any, tmp_path: Path):
    page, wrong = opened(browser, page_of(made("voxels"), HOSTILE)[0], tmp_path)
    assert page.title() == HOSTILE
    page.click("#information")
    assert page.locator("#facts dd").first.text_content() == HOSTILE
    assert page.locator("img").count() == 0
    assert not wrong
    page.close()


def test_pages_have_strict_csp_and_no_local_paths():
    for text in (
        page_of(made("tensorf"), HOSTILE)[0],
        render_gallery_page(HOSTILE, [("a b/field.html", HOSTILE, HOSTILE)]),
    ):
        script = re.findall(r"<script>(.*?)</script>", text, re.S)
        assert len(script) == 1
        allowed = re.search(r"script-src 'sha256-([^']+)'", text)
        assert allowed and base64.b64decode(allowed[1]) == hashlib.sha256(script[0].encode()).digest()
        assert "<img" not in text
    compact = made("tensorf")
    with np.load(io.BytesIO(compact)) as file:
        header = json.loads(file["header"].tobytes())
    assert header["config"]["dataset"]["path"] == header["scene"]["source"] == "photos"


def test_field_page_script_is_clean(tmp_path: Path):
    (tmp_path / "page.js").write_text("\n".join(map(read_minified, SCRIPTS)), encoding="utf-8")
    linter = Path(sys.executable).with_name("oxlint")
    found = subprocess.run([str(linter), "--deny-warnings", "page.js"], cwd=tmp_path, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout


def test_render_image_page_image_is_lossless():
    picture = np.random.default_rng(0).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    text = render_image_page(picture, HOSTILE, [("note", HOSTILE)])
    packed = re.search(r"data:image/webp;base64,([^\"]+)", text)
    assert packed and (imageio.imread(base64.b64decode(packed[1]), extension=".webp") == picture).all()
    assert text.count("<img") == 1


def test_bake_voxels_keeps_density():
    cfg = compose_config(["recipe=mlp_small"], Path("unused"))
    frame, orbit, _ = parse_metadata(scene_of(False), "made")
    system = build_system(cfg, frame)
    assert isinstance(system, NeRF3D) and orbit is not None
    voxels, options = bake_voxels(system.eval(), orbit, 16)
    assert OmegaConf.create(options).max_resolution == 16
    inside = system.field.bounds.to_world(voxels.index.view(17, 17, 17)[4:-4, 4:-4, 4:-4].nonzero().add(4) / 16)
    assert len(inside) > 100
    torch.testing.assert_close(voxels.density(inside), system.field.density(inside), rtol=1e-3, atol=1e-4)
