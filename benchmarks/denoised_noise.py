"""What a pixel of the denoised render errs, over what its tile states: where `pipeline.budget.pixels.TYPICAL` is from.

    .venv/bin/python -m benchmarks.denoised_noise [--capture sample_captures/counter] [--out build/denoised_noise]

The draft of a capture is rendered with `SEEDS` seeds of 16 samples, and once with ten times as many. Errors of pixels
over what the render states, times a share of it, should hold 50, 68 and 95 % within the central intervals.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.budget import QUANTILES
from pipeline.budget.pixels import COVERED, SHADOW, TYPICAL
from pipeline.run.cli import say
from pipeline.run.formats import read_exr
from pipeline.types import Raster

ROOT = Path(__file__).resolve().parents[1]
SEEDS, FEW, MANY = 5, 16, 160
INSIDE = 5  # px, of the square about a pixel that must be all object


def rendered(capture: Path, out: Path, samples: int, seed: int) -> Raster:
    """The layers of a draft with so many samples; stages before the render are made once."""
    kept = out / f"layers_{samples}_{seed}.exr"
    if not kept.exists():
        words = ["run", str(capture), "--out", str(out / "build"), "--quality", "draft", "--upto", "render"]
        for setting in (f"render.samples={samples}", "render.depth=8", f"render.seed={seed}"):
            words += ["--set", setting]
        subprocess.run([sys.executable, "-m", "stages", *words], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        shutil.copy(out / "build/render/layers.exr", kept)
    return read_exr(kept)


def shown(layers: Raster) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Values and stated sigmas (H, W, 3): of objects, and of the change relative to the plate."""
    obj, without = layers.rgb("obj"), np.maximum(layers.rgb("without"), 1e-9)
    size = [np.sqrt(np.mean(np.square(values), -1, keepdims=True)) for values in (obj, without)]
    hue = np.abs(obj) / np.maximum(size[0], 1e-9)
    change = (layers.rgb("lost") + layers.rgb("gained")) / without
    by_level = np.broadcast_to(layers["noise.change"][..., None] / np.maximum(size[1], 1e-9), change.shape)
    return {"object": (obj, hue * layers["noise.obj"][..., None]), "shadow": (change, by_level)}


def main() -> None:
    """Render what is missing, and say what each share holds."""
    from scipy.ndimage import minimum_filter

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--capture", type=Path, default=ROOT / "sample_captures/counter")
    parser.add_argument("--out", type=Path, default=ROOT / "build/denoised_noise")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    runs = [rendered(asked.capture, asked.out, FEW, seed) for seed in range(1, SEEDS + 1)]
    best = rendered(asked.capture, asked.out, MANY, 99)
    truth = shown(best)
    covers = np.stack([layers["obj.A"] for layers in [*runs, best]])
    places = {
        "object": minimum_filter((covers > COVERED).all(0), INSIDE),
        "shadow": (covers == 0).all(0) & (np.abs(truth["shadow"][0]).max(-1) > SHADOW),
    }
    for name, where in places.items():
        error = np.stack([shown(layers)[name][0] - truth[name][0] for layers in runs])[:, where]
        sigma = np.stack([shown(layers)[name][1] for layers in runs])[:, where]
        for share in (1.0, TYPICAL):
            z = np.abs(error) / np.maximum(share * sigma, 1e-12)
            held = ", ".join(f"{100 * (z < limit).mean():.0f}" for limit in QUANTILES.values())
            say(f"{name}: of {share:g} of what is stated, 50, 68 and 95 % intervals hold {held} %")


if __name__ == "__main__":
    main()
