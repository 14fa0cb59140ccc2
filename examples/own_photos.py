"""From photos with printed tags to a scene, a field, an orbit video and a compact file.

python examples/own_photos.py SHEET_PHOTOS OBJECT_PHOTOS --tag 0.06
"""

from argparse import ArgumentParser
from pathlib import Path

import imageio.v3 as imageio

import nerf_lightning as nl
from nerf_lightning.cli.capture import capture

if __name__ == "__main__":
    parser = ArgumentParser()
    parser.add_argument("sheet", type=Path, help="folder of photos of the page of tags")
    parser.add_argument("photos", type=Path, help="folder of photos of the object with tags in view")
    parser.add_argument("--tag", type=float, required=True, help="side of a tag's black square, meters")
    parser.add_argument("--seconds", type=float, default=180, help="training time")
    parser.add_argument("--pixels", type=int, default=300, help="longest side of the scene's photos")
    args = parser.parse_args()
    capture(calibration=args.sheet, photos=args.photos, tag_size=args.tag, resize=args.pixels)
    run = nl.train("scene.npz", seconds=args.seconds, options=["+experiment=capture", "callbacks.orbit=null"])
    print(f"{run.psnr:.2f} dB on held-out photos")
    views = [run.render(run.orbit[i]).rgb for i in range(len(run.orbit))]
    frames = [(255 * view).round().byte().numpy() for view in views]
    imageio.imwrite("orbit.webp", frames, plugin="pillow", duration=50, loop=0)
    run.export.compact(output="field.npz")
