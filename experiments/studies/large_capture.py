"""Measure time and memory that opening a large capture takes, with synthetic photographs.

::

    python experiments/studies/large_capture.py                       # 300 of 4000 x 3000
    python experiments/studies/large_capture.py --downscale 4 --bent  # reduced, of a bent lens
    python experiments/studies/large_capture.py --bare                # without masks

Writes JPEG files with the noise of photographs, and masks of a ball that all cameras look at, to a
temporary folder, and opens it in another process, whose peak of memory is that of reading.
``--batches N`` then reads the views of N training steps of two views each.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

WIDTH, HEIGHT = 4000, 3000
FOCAL = 3600.0
DISTINCT = 6
"""Number of different photographs; the others are copies."""
RADIUS = 0.7
"""Radius of the ball, world units; with cameras at distance 3 it covers a fifth of each image."""

_OPEN = """
import json, sys, time
import numpy as np
from geosplat_jax.fit.runtime import peak_memory_mb
from geosplat_jax.io.dataset import load_dataset
from geosplat_jax.io.windows import around_object
scene, downscale, batches = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
began, used = time.perf_counter(), time.process_time()
dataset = load_dataset(scene, downscale=downscale)
found = {"seconds": time.perf_counter() - began, "processor_seconds": time.process_time() - used}
train = dataset.train
found |= {"images_mb": train.images.nbytes / 1e6, "read_again": train.images.read_again_count}
if train.has_masks:
    train, found["window_share"] = around_object(train, largest=0.4)
rng, times = np.random.default_rng(0), []
for _ in range(batches):
    began = time.perf_counter()
    train.images[rng.choice(len(train), 2, replace=False)]
    times.append(time.perf_counter() - began)
if times:
    found["batch_seconds"] = float(np.median(times))
found["peak_gb"] = peak_memory_mb() * 2**20 / 1e9
print(json.dumps({name: round(value, 3) for name, value in found.items()}))
"""


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Write 8-bit pixels; JPEG with the quality that cameras use."""
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT8)
    spec.attribute("compression", "jpeg:92" if path.suffix == ".jpg" else "zip")
    sink = oiio.ImageOutput.create(str(path))
    if sink is None:
        raise OSError(f"cannot write {path}: {oiio.geterror()}")
    if not (sink.open(str(path), spec) and sink.write_image(pixels) and sink.close()):
        raise OSError(f"cannot write {path}: {sink.geterror()}")


def photograph(rng: np.random.Generator) -> np.ndarray:
    """Return (H, W, 3) bytes: coarse blocks of colour, with the noise of a sensor."""
    coarse = rng.random((HEIGHT // 100, WIDTH // 100, 3)).repeat(100, 0).repeat(100, 1)
    noise = rng.normal(0.0, 0.015, (HEIGHT, WIDTH, 1))
    return (255 * np.clip(0.2 + 0.6 * coarse + noise, 0, 1)).astype(np.uint8)


def write_capture(folder: Path, *, count: int, bare: bool, bent: bool) -> None:
    """Write photographs around a ball, its masks, and their cameras."""
    rng = np.random.default_rng(0)
    for name in ("images", *(() if bare else ("masks",))):
        (folder / name).mkdir()
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    edge = FOCAL * np.tan(np.arcsin(RADIUS / 3.0))
    ball = np.hypot(rows - HEIGHT / 2, columns - WIDTH / 2) < edge
    frames = []
    for index in range(count):
        angle, height = 2 * np.pi * index / count, 0.5 * np.sin(7 * index)
        back = np.array([np.cos(angle), np.sin(angle), height])
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1], back) / np.linalg.norm(np.cross([0, 0, 1], back))
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], -1)
        pose[:3, 3] = 3.0 * back
        image, mask = (folder / f"{kind}/{index:03}" for kind in ("images", "masks"))
        if index < DISTINCT:
            write_image(image.with_suffix(".jpg"), photograph(rng))
        else:
            shutil.copy(folder / f"images/{index % DISTINCT:03}.jpg", image.with_suffix(".jpg"))
        if not bare and index:
            shutil.copy(folder / "masks/000.png", mask.with_suffix(".png"))
        elif not bare:
            write_image(mask.with_suffix(".png"), (255 * ball[..., None]).astype(np.uint8))
        frames.append({"file_path": f"images/{index:03}.jpg", "transform_matrix": pose.tolist()})
    lens = {"k1": -0.02, "k2": 0.01} if bent else {}
    content = {"fl_x": FOCAL, "w": WIDTH, "h": HEIGHT, **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def main() -> None:
    """Write a capture, open it, and print time and memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300, help="photographs")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--bare", action="store_true", help="without masks")
    parser.add_argument("--bent", action="store_true", help="of a lens that has to be undistorted")
    parser.add_argument("--batches", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_capture(folder, count=arguments.count, bare=arguments.bare, bent=arguments.bent)
        numbers = [str(arguments.downscale), str(arguments.batches)]
        command = [sys.executable, "-c", _OPEN, str(folder), *numbers]
        subprocess.run(command, check=True, env=os.environ)


if __name__ == "__main__":
    main()
