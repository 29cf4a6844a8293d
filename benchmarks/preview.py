"""Seconds until the first complete composite of diffuse_glossy, from a loaded scene: kernels cached, or compiled anew.

``python -m benchmarks.preview`` prints the CPU seconds of one, in a process that has compiled nothing; `cold` gives it
an empty folder for its kernels.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

import numpy as np

from benchmarks.estimators import Loaded, Made, insitu, load
from benchmarks.measures import Point, display, exposure_gain, middle, squared_error
from benchmarks.scenes import diffuse_glossy
from stages.knobs import PRESETS, Render

DRAFT = Render.model_validate(PRESETS["draft"]["render"])


def first(stage: Loaded, plate: np.ndarray, seed: int) -> Made:
    """The first composite with the knobs of draft."""
    return next(insitu(stage, plate, DRAFT, seed, every=False))


def warm(stage: Loaded, plate: np.ndarray, truths: list[np.ndarray], chosen: np.ndarray, replicates: int) -> Point:
    """Median error on the ``chosen`` pixels, and CPU seconds, with cached kernels."""
    gain = exposure_gain(plate)
    first(stage, plate, 0)
    points = []
    for turn in range(replicates):
        made = first(stage, plate, 1 + turn)
        error = squared_error(display(made.picture[chosen], gain), *truths)
        points.append(Point(error, made.cpu_s, made.samples))
    return middle(points)


def cold(width: int, height: int) -> float:
    """CPU seconds in a new process without any compiled kernel."""
    with tempfile.TemporaryDirectory() as home:
        command = [sys.executable, "-m", "benchmarks.preview", str(width), str(height)]
        done = subprocess.run(command, env={**os.environ, "HOME": home}, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def main() -> None:
    """One composite at the size of the two arguments; the plate comes without the renderer, so nothing is compiled."""
    width, height = (int(v) for v in sys.argv[1:3])
    stage = load(diffuse_glossy(width, height))
    plate = np.full((width * height, 3), 0.3)
    print(first(stage, plate, 1).cpu_s)  # noqa: T201  its only result


if __name__ == "__main__":
    main()
