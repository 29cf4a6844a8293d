"""A calibration photograph as two grey pictures: for finding markers and for measuring corners.

JPEG, PNG and integer TIFF are read as they are; RAW, HEIC and linear files through the one door for photographs, a
mosaic balanced and demosaicked first. A corner of a board is symmetric about itself, so no tone curve moves it.
Limits: nothing is merged; a RAW photograph of a board is one exposure.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.camera.markers import grey, tone
from pipeline.camera.opencv_bridge import read_grey
from pipeline.image.colour import decode_srgb
from pipeline.image.demosaic import balance_gains, demosaic
from pipeline.image.frames import read_frame, read_samples
from pipeline.types import Frame

PLAIN = (".jpg", ".jpeg", ".png")


def board_picture(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) uint8 for finding, and (H, W) uint8 or float32 for measuring, both as the pixels lie on the sensor.

    Raises CaptureError when the file cannot be read.
    """
    if path.suffix.lower() in PLAIN:
        plain = read_grey(path)
        return plain, plain
    frame = read_frame(path)
    samples = read_samples(path, frame)
    if samples.dtype == np.uint8 and frame.encoding == "display":
        plain = np.asarray(samples.mean(-1) + 0.5, np.uint8)
        return plain, plain
    toned = tone(light_of(samples, frame))
    return np.asarray(toned * 255 + 0.5, np.uint8), toned


def linear_of(file: Path) -> np.ndarray:
    """(H, W) float32 linear grey of a further photograph, a finished picture."""
    return np.asarray(decode_srgb(np.asarray(read_grey(file), np.float32) / 255), np.float32)


def light_of(samples: np.ndarray, frame: Frame) -> np.ndarray:
    """(H, W) float32 grey of stored samples, a mosaic balanced by its own mean: a board is grey, its light is not.

    Without balance the colours of the mosaic would print their pattern on every edge.
    """
    white = frame.white or float(samples.max(initial=1))
    if not frame.cfa:
        return grey((samples - np.asarray(frame.black, np.float32)) / np.float32(white))
    height, width = samples.shape
    black = np.tile(np.broadcast_to(frame.black, (2, 2)), ((height + 1) // 2, (width + 1) // 2))[:height, :width]
    mosaic = np.asarray((samples - black) / (white - black), np.float32)
    cells = {
        letter: [mosaic[i // 2 :: 2, i % 2 :: 2] for i, c in enumerate(frame.cfa) if c == letter] for letter in "RGB"
    }
    neutral = np.array([max(float(np.mean([plane.mean() for plane in cells[letter]])), 1e-6) for letter in "RGB"])
    return grey(demosaic(mosaic * balance_gains(neutral / neutral[1], frame.cfa, mosaic.shape), frame.cfa, "malvar"))
