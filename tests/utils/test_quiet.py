"""What libraries may say."""

import os
import threading

import cv2
import numpy as np
import pytest

from nerf_lightning.dataset import load_picture
from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import native_errors_hidden


def test_a_damaged_photo_is_told_once(tmp_path, capfd: pytest.CaptureFixture[str]):
    photo, noise = tmp_path / "photo.jpg", np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    good = cv2.imencode(".jpg", noise)[1].tobytes()
    photo.write_bytes(good[:20] + bytes(300) + good[320:])
    cv2.imdecode(np.frombuffer(photo.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert "JPEG" in capfd.readouterr().err, "the library says something by itself"
    with pytest.raises(InputError, match=r"photo\.jpg: found"):
        load_picture(photo)
    assert capfd.readouterr().err == ""
    os.write(2, b"heard again\n")
    assert capfd.readouterr().err == "heard again\n"


def test_the_last_thread_gives_standard_error_back(capfd: pytest.CaptureFixture[str]):
    inside, leave = threading.Event(), threading.Event()

    def stay() -> None:
        with native_errors_hidden():
            inside.set()
            leave.wait()

    thread = threading.Thread(target=stay)
    thread.start()
    inside.wait()
    with native_errors_hidden():
        pass
    os.write(2, b"hidden\n")
    leave.set()
    thread.join()
    os.write(2, b"shown\n")
    assert capfd.readouterr().err == "shown\n"
