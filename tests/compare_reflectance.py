"""The routes to the albedo on a corner scene of known truth, with CPU seconds: ``python tests/compare_reflectance.py``.

A textured floor with a wall and a cube under lamp and sky, 160 x 120 pixels, path traced with 256 samples, 12 bounces.
Errors are relative, over 4 x 4 texels of 256 x 256 that the plate shows wholly.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from small_plates import CAMERA, VIEW, box, ground, lamp_and_sky, photograph, texture

from pipeline.transport.gradient import STEPS, fit
from pipeline.transport.patches import enlarged
from pipeline.types import Proxy, Raster
from stages import knobs, reflectance

LAMP = lamp_and_sky(300.0, (-0.3, 0.7, 0.4))
COLORS = ((0.7, 0.3, 0.2), (0.2, 0.6, 0.3))
PROXIES = [box((-0.05, 0.25, -0.5), (0.9, 0.5, 0.04), "wall"), box((0.3, 0.06, 0.0), (0.12, 0.12, 0.12), "cube")]


def main() -> None:
    """Print one row per route."""
    truth = texture(0, amount=0.1)
    plate = photograph(truth, LAMP, proxies=tuple(zip(PROXIES, COLORS)), samples=64, depth=12)

    def ratio(proxies: list[Proxy], route: str = "ratio"):
        light = Raster(Raster.split(LAMP), "acescg")
        params = knobs.Reflectance(texture_px=256, route=route)
        return reflectance.compute({"plate": plate}, CAMERA, {"plate": VIEW}, light, [], ground(), proxies, [], params)

    def blind() -> np.ndarray:
        """Gradient descent alone, from grey: the texture is smooth, the proxies start grey."""
        grey = [proxy.model_copy(update={"albedo": np.full(3, 0.5)}) for proxy in PROXIES]
        found = fit(ground(), np.full((256, 256, 3), 0.3), grey, [], LAMP, plate, CAMERA, VIEW, 2 * STEPS)
        return 0.3 * enlarged(found.factor, 256, 256)

    seen = ratio(PROXIES).outputs["albedo"]["seen"]
    known = seen.reshape(64, 4, 64, 4).min((1, 3)) > 0.9
    routes: dict[str, Callable[[], np.ndarray]] = {
        "one step, proxies ignored": lambda: ratio([]).outputs["albedo"].rgb(),
        "ratio": lambda: ratio(PROXIES).outputs["albedo"].rgb(),
        "gradient, from the ratio": lambda: ratio(PROXIES, "gradient").outputs["albedo"].rgb(),
        "gradient, from grey": blind,
    }
    sys.stdout.write(f"{'route':28}{'median':>8}{'bias':>8}{'95 %':>8}{'CPU s':>8}\n")
    for name, route in routes.items():
        start = time.process_time()
        found = route()
        spent = time.process_time() - start
        error = (means(found) / means(truth) - 1)[known]
        figures = np.median(np.abs(error)), np.median(error), np.quantile(np.abs(error), 0.95)
        sys.stdout.write(f"{name:28}" + "".join(f"{100 * figure:7.2f}%" for figure in figures) + f"{spent:8.1f}\n")
        sys.stdout.flush()


def means(values: np.ndarray) -> np.ndarray:
    """4 x 4 means of (256, 256, 3)."""
    return values.reshape(64, 4, 64, 4, 3).mean((1, 3))


if __name__ == "__main__":
    main()
