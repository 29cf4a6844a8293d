"""What a lens loses towards the corners: from photographs of an even surface, from the file, or from a lens database.

Flat frames: block means of each colour's photosites, weighted by their noise; the logarithm is a level per photograph
and colour, a plane per photograph (no surface is lit evenly: an even slope is the light's) and an even polynomial of
the radius shared by all of them. Blocks that stick out (dust, a fold) are left out; what the rest scatters by, beyond
noise, is the stated uncertainty.

Sources: Goldman 2010 (polynomial in the radius), DNG 1.7.1 FixVignetteRadial, lensfun's database of lenses
(K. Sonnenschein, measured by its users; no uncertainty stated).
Limits: the loss is taken as round about the picture's centre; a slope that is the lens's own (a decentred lens, a
shading sensor) goes into the plane and stays; DNG's GainMap is not read.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.conventions import CLIPPED, HOT
from pipeline.image.lens_database import vignetting_gain
from pipeline.run.errors import CaptureError
from pipeline.types import Raster

BLOCKS = 64  # along the longer side
POWERS = (2, 4, 6)
ROBUST = 5.0
MODEL_SIGMA = 0.001  # relative, at the corner: what three terms leave of a lens whose rim is in the way
TABLE = 2049  # radii of a tabulated gain
HALF_FRAME_MM = np.hypot(36, 24) / 2  # diagonal of a 35 mm frame


@dataclass(frozen=True, eq=False)
class Vignetting:
    """Loss ``exp(sum_i k_i r^(2 i + 2))``, r = 1 at the corners, and the covariance (3, 3) of k."""

    k: np.ndarray
    covariance: np.ndarray
    scatter: float = 0.0  # relative, of blocks about the fit, beyond their noise
    slope: float = 0.0  # largest change of the flats' light across half a diagonal, relative
    left_out: float = 0.0  # share of blocks

    def gain(self, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) float32 that undoes the loss, and its relative standard uncertainty (H, W)."""
        table = np.linspace(0.0, 1.0, TABLE)
        basis = _powers(table)
        sigma = np.sqrt(
            np.einsum("np,pq,nq->n", basis, self.covariance, basis) + self.scatter**2 + (MODEL_SIGMA * table) ** 2
        )
        squared = radius_squared(height, width, (0.5, 0.5))
        gain, spread = (np.interp(squared, table, values) for values in (np.exp(-basis @ self.k), sigma))
        return gain.astype(np.float32), spread.astype(np.float32)


def radius_squared(height: int, width: int, centre: tuple[float, float]) -> np.ndarray:
    """(H, W) squared distance from a centre (x, y in [0, 1]), 1 at the farthest corner."""
    x0, y0 = centre[0] * width, centre[1] * height
    y, x = np.ogrid[:height, :width]
    farthest = max(x0, width - x0) ** 2 + max(y0, height - y0) ** 2
    return np.asarray(((x + 0.5 - x0) ** 2 + (y + 0.5 - y0) ** 2) / farthest)


def _powers(squared: np.ndarray) -> np.ndarray:
    """(N, 3) even powers of the radius, of squared radii (N,)."""
    return np.stack([squared ** (power // 2) for power in POWERS], -1)


@dataclass(frozen=True, eq=False)
class Flat:
    """Block means of one photograph of an even surface: logarithm, its variance, place, and number of the colour."""

    log: np.ndarray  # (N,)
    variance: np.ndarray  # (N,)
    place: np.ndarray  # (N, 2) from the centre, the corners at distance 1
    colour: np.ndarray  # (N,) int


def blocks_of(values: np.ndarray, variance: np.ndarray, usable: np.ndarray) -> Flat:
    """Blocks of a mosaic (H, W), its 2x2 cells apart, or of (H, W, 3); variances finite where ``usable`` (H, W)."""
    if values.ndim == 3:
        parts = [_blocks(values[..., c], variance[..., c], usable, (0.0, 0.0)) for c in range(3)]
    else:  # a photosite lies beside the middle of its cell
        cells = [(slice(r, None, 2), slice(c, None, 2), ((c - 0.5) / 2, (r - 0.5) / 2)) for r, c in np.ndindex(2, 2)]
        parts = [_blocks(values[r, c], variance[r, c], usable[r, c], offset) for r, c, offset in cells]
    number = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    log, spread, place = (np.concatenate(one) for one in zip(*parts))
    return Flat(log, spread, place, number)


def _blocks(
    values: np.ndarray, variance: np.ndarray, usable: np.ndarray, offset: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log of the mean, its variance and place of every block with at least half of its pixels usable, and light."""
    height, width = values.shape
    size = max(1, round(max(height, width) / BLOCKS))
    rows, columns = height // size, width // size
    top, left = (height - rows * size) // 2, (width - columns * size) // 2

    def total(plane: np.ndarray) -> np.ndarray:
        part = plane[top : top + rows * size, left : left + columns * size]
        return part.reshape(rows, size, columns, size).sum((1, 3), dtype=float)

    count = total(usable)
    mean = total(np.where(usable, values, 0)) / np.maximum(count, 1)
    spread = total(np.where(usable, variance, 0)) / np.maximum(count, 1) ** 2
    good = (count >= size * size / 2) & (mean > 0) & (mean**2 > 2500 * spread)
    y, x = np.mgrid[:rows, :columns] * size + size / 2 + np.array([top, left])[:, None, None]
    place = np.stack([x - width / 2 + offset[0], y - height / 2 + offset[1]], -1) / np.hypot(width / 2, height / 2)
    return np.log(mean[good]), (spread / np.maximum(mean, 1e-30) ** 2)[good], place[good]


def fit(flats: list[Flat]) -> Vignetting | None:
    """The loss that all photographs share; None when their blocks do not reach from the centre to the corners."""
    place = np.concatenate([flat.place for flat in flats])
    squared = (place**2).sum(-1)
    if len(squared) == 0 or squared.min() > 0.05 or squared.max() < 0.8:
        return None
    log = np.concatenate([flat.log for flat in flats])
    noise = np.sqrt(np.concatenate([flat.variance for flat in flats]))
    frame = np.repeat(np.arange(len(flats)), [len(flat.log) for flat in flats])
    level = frame * 4 + np.concatenate([flat.colour for flat in flats])
    levels = (level[:, None] == np.unique(level)).astype(float)
    planes = np.concatenate([place * (frame == i)[:, None] for i in range(len(flats))], -1)
    design = np.concatenate([_powers(squared), planes, levels], -1)
    kept, scatter = np.ones(len(log), bool), 0.0
    for _ in range(20):
        weight = 1 / np.hypot(noise, scatter)
        solved = np.linalg.lstsq(design[kept] * weight[kept, None], log[kept] * weight[kept], rcond=None)[0]
        left = log - design @ solved
        pull = np.abs(left) * weight
        inner = 1.4826 * np.median(np.abs(left[kept]))
        new_scatter = float(np.sqrt(max(inner**2 - np.median(noise[kept] ** 2), 0.0)))
        still = pull <= ROBUST * max(1.0, 1.4826 * float(np.median(pull[kept])))
        if np.array_equal(still, kept) and abs(new_scatter - scatter) < 1e-7:
            break
        kept, scatter = still, new_scatter
    covariance = np.linalg.inv((design[kept] * weight[kept, None]).T @ (design[kept] * weight[kept, None]))
    slopes = solved[len(POWERS) : len(POWERS) + 2 * len(flats)].reshape(-1, 2)
    own = slice(0, len(POWERS))
    return Vignetting(
        solved[own], covariance[own, own], scatter, float(np.hypot(*slopes.T).max()), float(1 - kept.mean())
    )


def radial_gain(parameters: np.ndarray, height: int, width: int) -> np.ndarray:
    """(H, W) float32 gain of DNG's FixVignetteRadial: k0..k4 of r^2..r^10, and its centre (7,)."""
    *k, x, y = (float(value) for value in parameters)
    squared = radius_squared(height, width, (x, y))
    return (1 + squared * np.polynomial.polynomial.polyval(squared, k)).astype(np.float32)


class Losses:
    """Which loss is undone in which view, and what is said of it.

    ``facts``: [lens] of capture.toml. ``flats``: merged photographs of an even surface, by view. ``profiles``: what
    merge says of every view's camera and optics.
    """

    def __init__(self, facts: dict[str, Any], flats: dict[str, Raster], profiles: dict[str, dict[str, Any]]) -> None:
        self.facts, self.profiles = facts, profiles
        self.numbers: dict[str, Any] = {}
        self.warnings: list[str] = []
        self.flat = next(iter(flats), None)
        self.fitted = fit([_flat_of(raster) for raster in flats.values()]) if flats else None
        self.plate = profiles.get("plate") or next(iter(profiles.values()))
        self._gains: dict[tuple[Any, ...], tuple[np.ndarray, np.ndarray | None, str] | None] = {}
        if flats and self.fitted is None:
            raise CaptureError(
                f"{', '.join(flats)}: too dark, clipped or too small to measure the corners' loss; photograph an even "
                "surface that fills the frame at half of full exposure: [lens] flat"
            )
        if self.fitted is not None:
            gain, sigma = self.fitted.gain(64, 96)
            self.numbers["vignetting"] = {
                "photographs": len(flats), "corner_gain": float(gain[0, 0]), "corner_sigma_rel": float(sigma[0, 0]),
                "light_slope_rel": self.fitted.slope, "blocks_left_out": self.fitted.left_out,
                "scatter_rel": self.fitted.scatter,
            }  # fmt: skip

    def _found(
        self, profile: dict[str, Any], shape: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray | None, str] | None:
        """Gain (H, W), relative sigma (H, W) where it is known, and the source; None when nothing is known."""
        optics = profile.get("optics") or {}
        key = (profile["camera"], *(str(optics.get(name)) for name in ("lens", "focal_mm", "fnumber")), shape)
        if key not in self._gains:
            self._gains[key] = self._look_up(profile, optics, shape)
        return self._gains[key]

    def _look_up(
        self, profile: dict[str, Any], optics: dict[str, Any], shape: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray | None, str] | None:
        if self.facts.get("vignetting") == "none":
            return None
        if self.fitted is not None and self.flat is not None and same_optics(profile, self.profiles[self.flat]):
            return *self.fitted.gain(*shape), "flat photographs"
        if optics.get("vignetting") is not None:
            return radial_gain(np.array(optics["vignetting"], float), *shape), None, "FixVignetteRadial of the file"
        name = optics.get("lens") or (self.facts.get("name") if profile["camera"] == self.plate["camera"] else "") or ""
        known = vignetting_gain(profile["camera"], name, optics.get("focal_mm", 0), optics.get("fnumber", 0), *shape)
        return None if known is None else (known[0], None, f"lensfun, {known[1]}")

    def corrected(self, merged: Raster, profile: dict[str, Any]) -> Raster:
        """The merged view, its loss undone where it is known; the gain's uncertainty is in the variance."""
        found = self._found(profile, merged.shape)
        if found is None:
            return merged
        gain, sigma, _ = found
        channels = dict(merged.channels)
        for name in (key for key in channels if key in ("Y", "R", "G", "B")):
            spread = "variance" if name == "Y" else f"variance.{name}"
            channels[name] = channels[name] * gain
            channels[spread] = channels[spread] * gain * gain
            if sigma is not None:
                channels[spread] = channels[spread] + (channels[name] * sigma) ** 2
        return Raster(channels, merged.space, merged.attributes)

    def evidence(
        self, views: list[str], profiles: dict[str, dict[str, Any]], shapes: dict[str, tuple[int, int]]
    ) -> list[dict[str, Any]]:
        """One row for all views that share a source."""
        by_source: dict[str, list[str]] = {}
        corner: dict[str, float] = {}
        short: list[float] = []  # focal lengths, 35 mm, of views that stay as they are; 0: unknown
        for view in views:
            found = self._found(profiles[view], shapes[view])
            source = found[2] if found else ""
            by_source.setdefault(source, []).append(view)
            if found:
                corner[source] = max(corner.get(source, 1.0), float(found[0].max()))
            else:
                short.append(float((profiles[view].get("optics") or {}).get("focal_35mm") or 0))
        if self.fitted is not None and (left := by_source.get("", [])):
            self.warnings.append(
                f"{', '.join(left)}: not of the camera, focal length and aperture of the flat photographs; their "
                "corners stay dark"
            )
        shortest = min(short, default=0.0)
        return [
            _evidence(source, names, corner.get(source, 1.0), self.facts, shortest)
            for source, names in by_source.items()
        ]


def _evidence(source: str, views: list[str], corner: float, facts: dict[str, Any], shortest: float) -> dict[str, Any]:
    """A row; ``shortest``: focal length of views without a source, in 35 mm terms, 0 where one is not known."""
    which = ", ".join(views)
    if not source:
        because = (
            "not wanted" if facts.get("vignetting") == "none" else "no flat photographs, and no lens that is known"
        )
        cost = "radiance low by about the cosine to the fourth of the field angle at the corners"
        row = {"term": "vignetting", "modelled": False, "because": f"{which}: {because}", "could_cost": cost}
        if not shortest:
            return row | {"no_bound": "no metadata state the field of view"}
        return row | {"bound_rel": 1 - (1 + (HALF_FRAME_MM / shortest) ** 2) ** -2}
    cost = "what is stated in the variance" if source.startswith("flat") else "no uncertainty is stated with it"
    because = f"{which}: {source}, {corner:.2f} times at the corners"
    return {"term": "vignetting", "modelled": True, "because": because, "could_cost": cost}


def same_optics(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two profiles are of one camera at one focal length and aperture, to 2 %."""
    first, second = one.get("optics") or {}, other.get("optics") or {}
    alike = (np.isclose(first.get(key, 0), second.get(key, 0), rtol=0.02) for key in ("focal_mm", "fnumber"))
    return one["camera"] == other["camera"] and all(alike)


def _flat_of(raster: Raster) -> Flat:
    mosaic = "Y" in raster.channels
    values = raster["Y"] if mosaic else raster.rgb()
    variance = raster["variance"] if mosaic else raster.rgb("variance")
    usable = np.isfinite(variance if mosaic else variance.max(-1)) & (raster["mask"] & (CLIPPED | HOT) == 0)
    return blocks_of(values, np.where(np.isfinite(variance), variance, 0), usable)
