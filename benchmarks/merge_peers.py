"""What the merge is compared with, all on the same five frames in memory.

- ``numpy``: sum of counts over sum of times of the unclipped samples, plainly.
- ``debevec``, ``robertson``: OpenCV's, 8 bit in (which is all they take; the conversion is not timed), linear response.
- ``colour_hdri``, ``hdrutils``: in an environment of their own, `make bench-merge-env`; left out when there is none.
  HDRutils decodes files; its reading is replaced by arrays and its demosaicking left out, so that its merge is timed.

Run as a command this file is the worker of the last two: ``merge_peers.py FOLDER LIBRARY`` reads frames.npy and
meta.json and writes LIBRARY.npy and LIBRARY.json.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ENVIRONMENT = Path(os.environ.get("INSITU_MERGE_PEERS", ".merge-peers/bin/python"))
LIBRARIES = ("colour_hdri", "hdrutils")


def plain(mosaics: np.ndarray, exposures: list[float], black: float, white: float) -> np.ndarray:
    """Counts over times, (H, W) float32; unclipped samples only."""
    top, bottom = np.zeros(mosaics[0].shape, np.float32), np.zeros(mosaics[0].shape, np.float32)
    for mosaic, exposure in zip(mosaics, exposures, strict=True):
        used = mosaic < white
        top += np.where(used, mosaic - np.float32(black), np.float32(0))
        bottom += used * np.float32(exposure)
    return top / np.maximum(bottom, np.float32(exposures[0] / 2)) / np.float32(white - black)


def opencv(name: str, eight: list[np.ndarray], exposures: list[float]) -> np.ndarray:
    """(H, W) of OpenCV's merge of (H, W) uint8 frames, each three samples of a row as one pixel."""
    import cv2

    packed = [frame.reshape(frame.shape[0], -1, 3) for frame in eight]
    merge = cv2.createMergeDebevec() if name == "debevec" else cv2.createMergeRobertson()
    response = np.repeat(np.arange(256, dtype=np.float32)[:, None, None] / 255 + 1e-6, 3, 2)
    return merge.process(packed, np.array(exposures, np.float32), response).reshape(eight[0].shape)


def eight_bit(mosaic: np.ndarray, black: float, white: float) -> np.ndarray:
    """Linear 8-bit samples."""
    return np.clip(np.rint((mosaic - black) * (255 / (white - black))), 0, 255).astype(np.uint8)


def external(folder: Path, library: str, repeats: int) -> tuple[np.ndarray, float] | None:
    """Result and CPU seconds (the least of some) of a library in its environment on the frames in ``folder``."""
    python = ENVIRONMENT
    if not python.exists():
        return None
    done = subprocess.run(
        [python, "-P", __file__, folder, library, str(repeats)], check=False, capture_output=True, text=True
    )
    if done.returncode:
        sys.stderr.write(done.stderr[-2000:])
        return None
    return np.load(folder / f"{library}.npy"), json.loads((folder / f"{library}.json").read_text())["cpu_s"]


def _colour_hdri(frames: np.ndarray, meta: dict[str, Any]) -> np.ndarray:
    import colour_hdri

    scale = 1 / (meta["white"] - meta["black"])
    stack = colour_hdri.ImageStack()
    for frame, exposure in zip(frames, meta["exposures"], strict=True):
        facts = colour_hdri.Metadata(f_number=1, exposure_time=exposure, iso=100)
        stack.append(colour_hdri.Image("frame", (frame - meta["black"]) * scale, facts))
    return colour_hdri.image_stack_to_HDRI(stack)


def _hdrutils(frames: np.ndarray, meta: dict[str, Any]) -> np.ndarray:
    import colour_demosaicing

    module = importlib.import_module("HDRutils.merge")  # whose name is also that of a function in it
    merged: list[np.ndarray] = []

    def keep(mosaic: np.ndarray, pattern: str) -> np.ndarray:
        merged.append(mosaic)
        return np.zeros((1, 1, 3))

    module.io.imread = lambda number, libraw: frames[number]
    colour_demosaicing.demosaicing_CFA_Bayer_bilinear = keep
    count = len(frames)
    facts = {
        "exp": np.array(meta["exposures"]), "gain": np.ones(count), "aperture": np.ones(count),
        "black_level": np.full(4, meta["black"]), "saturation_point": 0.98 * meta["white"], "raw_format": True,
        "color_space": "raw", "h": frames.shape[1], "w": frames.shape[2], "libraw_scale": lambda picture: picture,
    }  # fmt: skip
    module.imread_merge_demosaic(list(range(count)), facts, False, "RGGB", "bilinear")
    return merged[0] / (meta["white"] - meta["black"])


def _worker(folder: Path, library: str, repeats: int) -> None:
    frames, meta = np.load(folder / "frames.npy"), json.loads((folder / "meta.json").read_text())
    merge = {"colour_hdri": _colour_hdri, "hdrutils": _hdrutils}[library]
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        result = merge(frames, meta)
        seconds.append(time.process_time() - start)
    np.save(folder / f"{library}.npy", result.astype(np.float32))
    (folder / f"{library}.json").write_text(json.dumps({"cpu_s": min(seconds)}))


if __name__ == "__main__":
    _worker(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
