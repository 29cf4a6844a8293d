"""How glossy is the plane? A ladder diffuse -> rough -> metallic, climbed only when held-out pixels ask for it.

From one view, gloss shows as a lobe of the distant light that moves over the plane with the viewing direction. With the
terms of glTF (GGX of alpha = roughness^2, separable Smith, Schlick; see `materials`), integrated over the map,

    G0 = integral of D V L cos,   G5 = the same times (1 - |v.h|)^5,   E5 = integral of (1 - |v.h|)^5 L cos

a dielectric shows base (1 - f0) (E - E5) / pi + f0 (G0 - G5) + G5 and a metal base (G0 - G5) + G5: in both, radiance is
``base * W + S`` with known fields W and S. The base of a cell of the plane is then (radiance - S) / W, and the model is
right whose bases vary as the texture of one material does: a multivariate t distribution (4 degrees of freedom, so that
boards and things on the plane do not rule), its mean and covariance fitted to training cells. The log-likelihood of
cells held out in blocks, in radiance, decides. Texture that varies smoothly over the whole view can look like a lobe;
blocks are large so that it has to be predicted from afar, and a rung must win by a margin over blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.conventions import latlong_directions
from pipeline.light.environment import irradiance, resize_environment
from pipeline.light.near_field import facing
from pipeline.run.evidence import TRIED
from pipeline.transport.patches import Lights, lights_of, upper
from pipeline.transport.reflectance import linear
from pipeline.types import Surface

CELLS = 20  # along the longer side of what is seen
BLOCK = 4  # cells along a side of a block that is held out as one
COLUMNS = 1000  # a block's number is row * COLUMNS + column
FREEDOM = 4.0  # of the t distribution
EM_STEPS = 12
ROUGHNESS = np.array([0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.8])  # finer lobes are narrower than the map's texels
F0 = np.array([0.02, 0.03, 0.04, 0.05, 0.065, 0.085, 0.12])
FINER = 9  # values of roughness and of f0 between two of the ladder's
FINE_MAP = (64, 128)  # texels of the map once a rung is taken
GRID = 48  # points along a side where the lobe is computed for the texture
HIDDEN_DEG = (30.0, 30.0)  # elevation and half angle of what a thing hides of the sky: it stands on the ground nearby
AZIMUTHS = 12  # from which it is asked what it would hide
SHADOW = 0.05  # of the radiance: a change that counts
MIN_CELLS = 48
MIN_GAIN = 5.0  # nats over all held-out cells
MIN_SIGMAS = 2.5  # of the sum over blocks
HIGHEST_BASE = 1.1
OBJECT_ROWS = 24  # of the map by which light on objects is compared


@dataclass(frozen=True, eq=False)
class Cells:
    """Means over cells of the seen plane: radiance and noise (variance), both (N, 3), ``view`` (N, 3), block (N,)."""

    radiance: np.ndarray
    noise: np.ndarray
    view: np.ndarray
    block: np.ndarray


@dataclass(frozen=True, eq=False)
class Fields:
    """Radiance = base * ``scale`` + ``offset``, both (..., N, 3)."""

    scale: np.ndarray
    offset: np.ndarray


@dataclass(frozen=True, eq=False)
class Lobes:
    """The integrals G0, G5 (R, N, 3) of each roughness and E, E5 (N, 3), at N viewing directions."""

    g0: np.ndarray
    g5: np.ndarray
    e: np.ndarray
    e5: np.ndarray


def lobes(lights: Lights, normal: np.ndarray, view: np.ndarray, roughness: np.ndarray) -> Lobes:
    """Integrals over the map for unit directions ``view`` (N, 3) towards the camera, for each roughness (R,)."""
    ways, flux = (part.astype(np.float32) for part in upper(lights, normal))
    view, normal = view.astype(np.float32), normal.astype(np.float32)
    cos_l, cos_v = ways @ normal, np.maximum(view @ normal, 1e-3)
    between = np.clip(view @ ways.T, -1, 1)  # (N, M)
    cos_h = (cos_v[:, None] + cos_l) / np.sqrt(2 + 2 * between)  # n.h
    edge = (1 - np.sqrt((1 + between) / 2)) ** 5  # (1 - v.h)^5
    g0, g5 = [], []
    square = cos_h * cos_h
    for alpha2 in (np.asarray(roughness, np.float32) ** 4).tolist():
        d = alpha2 / (np.pi * (square * (alpha2 - 1) + 1) ** 2)
        d *= _smith(alpha2, cos_l) / cos_l  # flux holds one cosine already, the BSDF's own cancels
        d *= (_smith(alpha2, cos_v) / (4 * cos_v))[:, None]
        g0.append(d @ flux)
        g5.append((d * edge) @ flux)
    e = np.broadcast_to(flux.sum(0), g0[0].shape)
    return Lobes(np.stack(g0), np.stack(g5), e, edge @ flux)


def _smith(alpha2: float, cosine: np.ndarray) -> np.ndarray:
    return 2 / (1 + np.sqrt(1 + alpha2 * (1 / cosine**2 - 1)))


def rough(found: Lobes, f0: np.ndarray) -> Fields:
    """Fields of a dielectric for each f0 (F,) and roughness, (F * R, N, 3)."""
    each = f0[:, None, None, None]
    offset = each * (found.g0 - found.g5) + found.g5
    scale = np.broadcast_to((1 - each) * (found.e - found.e5) / np.pi, offset.shape)
    return Fields(scale.reshape(-1, *offset.shape[2:]), offset.reshape(-1, *offset.shape[2:]))


def metal(found: Lobes) -> Fields:
    """Fields of a metal, (R, N, 3)."""
    return Fields(found.g0 - found.g5, found.g5)


def diffuse(found: Lobes) -> Fields:
    """Fields of a diffuse surface, (1, N, 3)."""
    return Fields(found.e[None] / np.pi, np.zeros((1, *found.e.shape)))


def fitted(base: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (K, 3) and scatter (K, 3, 3) of t distributions fitted to K sets of cells (K, N, 3), by EM.

    ``noise`` (K, N, 3): variance that the plate's noise alone gives a base; the scatter is never below its mean.
    """
    weight = np.ones(base.shape[:2])
    floor = np.einsum("kc,cd->kcd", noise.mean(1), np.eye(3)) + 1e-10 * np.eye(3)
    for _ in range(EM_STEPS):
        mean = (weight[..., None] * base).sum(1) / weight.sum(1)[:, None]
        away = base - mean[:, None]
        scatter = (away * weight[..., None]).swapaxes(1, 2) @ away / base.shape[1] + floor
        distance = _distance(away, scatter)
        weight = (FREEDOM + 3) / (FREEDOM + distance)
    return mean, scatter


def _distance(away: np.ndarray, scatter: np.ndarray) -> np.ndarray:
    return ((away @ np.linalg.inv(scatter)) * away).sum(-1)


def log_likelihood(fields: Fields, radiance: np.ndarray, mean: np.ndarray, scatter: np.ndarray) -> np.ndarray:
    """Log density (K, N) of radiance (N, 3) under the fields (K, N, 3), up to a constant common to all models."""
    scale = np.maximum(fields.scale, 1e-12)
    away = (radiance - fields.offset) / scale - mean[:, None]
    distance = _distance(away, scatter)
    size = np.linalg.slogdet(scatter)[1][:, None]
    return -(FREEDOM + 3) / 2 * np.log1p(distance / FREEDOM) - size / 2 - np.log(scale).sum(-1)


def best(
    fields: Fields, cells: Cells, train: np.ndarray, test: np.ndarray, any_base: bool = False
) -> tuple[int, np.ndarray, np.ndarray]:
    """Candidate (of K) that is likeliest on the training cells, its density on the test cells, and its mean base (3,).

    Candidates whose mean base is no albedo are out, unless ``any_base``; are all out, the density is minus infinity.
    """
    scale = np.maximum(fields.scale[:, train], 1e-12)
    base = (cells.radiance[train] - fields.offset[:, train]) / scale
    mean, scatter = fitted(base, cells.noise[train] / scale**2)
    inside = Fields(fields.scale[:, train], fields.offset[:, train])
    score = log_likelihood(inside, cells.radiance[train], mean, scatter).sum(1)
    if not any_base:
        score[~((mean > 0) & (mean < HIGHEST_BASE)).all(1)] = -np.inf
    chosen = int(np.argmax(score))
    if not np.isfinite(score[chosen]):
        return chosen, np.full(int(test.sum()), -np.inf), mean[chosen]
    one = slice(chosen, chosen + 1)
    outside = Fields(fields.scale[one][:, test], fields.offset[one][:, test])
    density = log_likelihood(outside, cells.radiance[test], mean[one], scatter[one])[0]
    return chosen, density, mean[chosen]


def climb(cells: Cells, environment: np.ndarray, normal: np.ndarray, gloss: str = "auto") -> Surface:
    """The surface that held-out cells ask for under a map (H, W, 3), with one row of scores per rung.

    ``gloss``: "always" takes the likelier of the glossy ones whether or not it wins, "never" the diffuse one.
    """
    if len(cells.radiance) < MIN_CELLS:
        return Surface(scores=[{"model": "diffuse", "because": f"only {len(cells.radiance)} cells are seen"}])
    found = lobes(lights_of(environment), normal, cells.view, ROUGHNESS)
    rungs = {"diffuse": diffuse(found), "rough": rough(found, F0), "metallic": metal(found)}
    fold = cells.block % 2 + 2 * (cells.block // COLUMNS % 2)
    everything = np.ones(len(fold), bool)
    held_out, rows = {}, []
    for name, fields in rungs.items():
        density, free = np.full(len(fold), -np.inf), name == "diffuse"  # the rung to start from, whatever the scale
        for number in np.unique(fold):
            density[fold == number] = best(fields, cells, fold != number, fold == number, free)[1]
        chosen, _, base = best(fields, cells, everything, everything, free)
        held_out[name] = density
        rows.append({**_named(name, chosen, ROUGHNESS, F0), "held_out": float(density.sum()), "base": base.tolist()})
    taken = 0
    for number, name in ((1, "rough"), (2, "metallic")):
        against = rows[taken]["model"]
        gain, sigmas = margin(held_out[name], held_out[against], cells.block)
        rows[number] |= {"against": against, "gain": gain, "sigmas": sigmas}
        if gloss == "auto" and gain > MIN_GAIN and sigmas > MIN_SIGMAS:
            taken = number
    if gloss == "always" and np.isfinite(max(rows[1]["held_out"], rows[2]["held_out"])):
        taken = max((1, 2), key=lambda number: rows[number]["held_out"])
    asked = rows[taken or 1]
    if np.isfinite(asked["gain"]):
        lobe = Lobe.of(cells, environment, normal, asked)
        asked["taken_for_matt"] = taken_for_matt(lobe, cells, normal)
        asked["objects_of_matt"] = objects_of_matt(lobe, cells, environment, normal)
    model: dict[str, Any] = {key: value for key, value in rows[taken].items() if key in Surface.model_fields}
    if taken:
        model |= refined(cells, environment, normal, model)
    return Surface(**model, scores=[{**row, "cells": len(fold)} for row in rows])


@dataclass(frozen=True, eq=False)
class Lobe:
    """A glossy rung on its cells: their ``base`` (N, 3), and by how much each counts, ``weight`` (N,) in [0, 1].

    The weight is that of the t distribution of bases, so that what is of another material has little say.
    """

    lights: Lights
    normal: np.ndarray
    model: dict[str, Any]
    base: np.ndarray
    weight: np.ndarray

    @staticmethod
    def of(cells: Cells, environment: np.ndarray, normal: np.ndarray, model: dict[str, Any]) -> Lobe:
        """Of a row of scores, under a map (H, W, 3)."""
        empty = np.zeros((0, 3))
        bare = Lobe(lights_of(environment), normal, model, empty, empty)
        whole, _ = bare.fields(bare.lights, cells.view)
        scale = np.maximum(whole.scale, 1e-12)
        base = (cells.radiance - whole.offset) / scale
        mean, scatter = fitted(base, cells.noise / scale**2)
        weight = np.minimum((FREEDOM + 3) / (FREEDOM + _distance(base - mean[:, None], scatter)[0]), 1.0)
        return replace(bare, base=np.maximum(base[0], 0), weight=weight)

    def fields(self, lights: Lights, view: np.ndarray) -> tuple[Fields, np.ndarray]:
        """W and S (1, N, 3) towards ``view`` (N, 3) under some lights, and their irradiance (N, 3)."""
        found = lobes(lights, self.normal, view, np.array([self.model["roughness"]]))
        if self.model["model"] == "metallic":
            return metal(found), found.e
        return rough(found, np.array([self.model["f0"]])), found.e


def taken_for_matt(lobe: Lobe, cells: Cells, normal: np.ndarray) -> float:
    """By how much shadows would be wrong if a glossy plane were taken for a matt one: a share of their change, median.

    From each of AZIMUTHS sides a thing hides a cap of the sky. The glossy plane loses ``base dW + dS`` of its radiance
    L there, the matt one ``L dE / E``. Pooled are all cells and sides where that changes L by more than SHADOW, a cell
    by its weight.
    """
    lights = lobe.lights
    light = lobe.fields(lights, cells.view)[1]
    level = np.linalg.norm(cells.radiance, axis=1)
    elevation, half = np.radians(HIDDEN_DEG)
    side, other = _across(normal)
    wrong = [np.zeros(0)]
    for azimuth in np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS:
        flat = np.cos(azimuth) * side + np.sin(azimuth) * other
        way = np.cos(elevation) * flat + np.sin(elevation) * normal
        hidden = lights.direction @ way > np.cos(half)
        lost, dark = lobe.fields(Lights(lights.direction[hidden], lights.power[hidden]), cells.view)
        glossy = lobe.base * lost.scale[0] + lost.offset[0]
        matt = cells.radiance * dark / np.maximum(light, 1e-12)
        change = np.linalg.norm(glossy, axis=1)
        counts = change > SHADOW * level
        wrong.append((lobe.weight * np.linalg.norm(matt - glossy, axis=1))[counts] / change[counts])
    pooled = np.concatenate(wrong)
    return float(np.median(pooled)) if len(pooled) else 0.0


def objects_of_matt(lobe: Lobe, cells: Cells, environment: np.ndarray, normal: np.ndarray) -> float:
    """By how much the light on diffuse objects would be wrong, if a glossy plane were taken for a matt one: a median.

    The matt plane sends every way what it sends the camera, the mean of the cells; the glossy one ``base W + S`` of the
    mean base. Compared is the irradiance on what a ball shows the camera, without the shadow of the ball.
    """
    small = resize_environment(environment, OBJECT_ROWS, 2 * OBJECT_ROWS)
    ways = latlong_directions(*small.shape[:2])
    below = ways @ normal < 0
    towards = lobe.fields(lights_of(environment, FINE_MAP), -ways[below])[0]  # finer lobes at grazing angles
    base, matt = (np.average(values, axis=0, weights=lobe.weight) for values in (lobe.base, cells.radiance))
    small[below] = base * towards.scale[0] + towards.offset[0]
    wrong = np.zeros(small.shape)
    wrong[below] = matt - small[below]
    normals, seen = facing(cells.view.mean(0))
    share = np.linalg.norm(irradiance(wrong, normals), axis=1) / np.linalg.norm(irradiance(small, normals), axis=1)
    order = np.argsort(share)
    return float(share[order][np.searchsorted(np.cumsum(seen[order]), 0.5)])


def _across(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (3,) that make a right angle with a unit normal and each other."""
    side = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    side = side / np.linalg.norm(side)
    return side, np.cross(normal, side)


def _named(name: str, candidate: int, roughness: np.ndarray, f0: np.ndarray) -> dict[str, Any]:
    """The values of a candidate of a rung; candidates of "rough" run over f0 first, then over roughness."""
    if name == "diffuse":
        return {"model": name}
    found: dict[str, Any] = {"model": name, "roughness": float(roughness[candidate % len(roughness)])}
    return found | ({"f0": float(f0[candidate // len(roughness)])} if name == "rough" else {"metallic": 1.0})


def refined(cells: Cells, environment: np.ndarray, normal: np.ndarray, model: dict[str, Any]) -> dict[str, Any]:
    """The likeliest values between the neighbours on the ladder's grid, under a finer map, from all cells."""
    roughness, f0 = (
        np.geomspace(values[max(at - 1, 0)], values[min(at + 1, len(values) - 1)], FINER)
        for values, at in (
            (ROUGHNESS, int(np.argmin(np.abs(ROUGHNESS - model["roughness"])))),
            (F0, int(np.argmin(np.abs(F0 - model.get("f0", F0[0]))))),
        )
    )
    found = lobes(lights_of(environment, FINE_MAP), normal, cells.view, roughness)
    fields = metal(found) if model["model"] == "metallic" else rough(found, f0)
    everything = np.ones(len(cells.block), bool)
    chosen, density, _ = best(fields, cells, everything, everything)
    return _named(model["model"], chosen, roughness, f0) if np.isfinite(density).all() else {}


def base_of(
    surface: Surface, radiance: np.ndarray, environment: np.ndarray, normal: np.ndarray, points: np.ndarray,
    eye: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Base colour (h, w, 3) of a glossy plane from its radiance (h, w, 3) at ``points`` (h, w, 3) seen from ``eye``.

    The lobe is computed at GRID x GRID points and interpolated; where the base has no weight (``W`` <= 0) it is NaN.
    """
    height, width = radiance.shape[:2]
    rows, columns = (np.linspace(0, size - 1, min(GRID, size)).round().astype(int) for size in (height, width))
    arm = eye - points[rows[:, None], columns[None]].reshape(-1, 3)
    view = arm / np.linalg.norm(arm, axis=1, keepdims=True)
    found = lobes(lights_of(environment, FINE_MAP), normal, view, np.array([surface.roughness]))
    fields = metal(found) if surface.model == "metallic" else rough(found, np.array([surface.f0]))
    at = [
        np.interp(np.arange(size), knots, np.arange(len(knots))) for size, knots in ((height, rows), (width, columns))
    ]

    def everywhere(field: np.ndarray) -> np.ndarray:
        return linear(linear(field[0].reshape(len(rows), len(columns), 3), at[0], 0), at[1], 1)

    scale, offset = everywhere(fields.scale), everywhere(fields.offset)
    return np.divide(radiance - offset, scale, out=np.full(radiance.shape, np.nan), where=scale > 0)


def margin(density: np.ndarray, against: np.ndarray, block: np.ndarray) -> tuple[float, float]:
    """Gain of one log density (N,) of held-out cells over another, and over its standard error by whole blocks."""
    if not np.isfinite(density).all():
        return -np.inf, -np.inf
    gain = density - against
    sums = np.bincount(np.unique(block, return_inverse=True)[1].ravel(), gain)
    error = np.sqrt(len(sums)) * sums.std(ddof=1) if len(sums) > 1 else np.inf
    return float(gain.sum()), float(gain.sum() / max(error, 1e-12))


def cells_of(
    radiance: np.ndarray, variance: np.ndarray, known: np.ndarray, points: np.ndarray, eye: np.ndarray
) -> Cells:
    """Cells of a texture's window (h, w, 3) that is known at (h, w), seen from ``eye`` (3,).

    ``points`` (h, w, 3) m. A cell counts when half of it is known.
    """
    rows, columns = np.nonzero(known.any(1))[0], np.nonzero(known.any(0))[0]
    top, left = rows[0], columns[0]
    size = max(1, -(-max(rows[-1] + 1 - top, columns[-1] + 1 - left) // CELLS))
    high, wide = (rows[-1] + 1 - top) // size, (columns[-1] + 1 - left) // size
    part = (slice(top, top + high * size), slice(left, left + wide * size))
    weight = known[part].astype(float)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = (values[part] * weight[..., None]).reshape(high, size, wide, size, -1).sum((1, 3))
        return sums / np.maximum(count, 1)[..., None]

    count = weight.reshape(high, size, wide, size).sum((1, 3))
    kept = count >= size * size / 2
    noise = mean(variance) / np.maximum(count, 1)[..., None]
    arm = eye - mean(points)
    view = arm / np.linalg.norm(arm, axis=-1, keepdims=True)
    row, column = np.mgrid[:high, :wide]
    block = row // BLOCK * COLUMNS + column // BLOCK
    return Cells(mean(radiance)[kept], noise[kept], view[kept], block[kept])


def explain(surface: Surface, gloss: str = "auto") -> dict[str, Any]:
    """The rung that was taken, and why, as evidence; ``gloss``: what was asked for, as in `climb`."""
    forced = "" if gloss == "auto" else f"knob reflectance.gloss = {gloss}; "
    scores = "; ".join(
        f"{row['model']} {row['gain']:+.1f} nats ({row['sigmas']:.1f} sigma) over {row['against']}"
        if np.isfinite(row["gain"]) else f"{row['model']} cannot have made the held-out cells"
        for row in surface.scores
        if "gain" in row
    )  # fmt: skip
    modelled = surface.model != "diffuse"
    asked: dict[str, Any] = next((row for row in surface.scores if "taken_for_matt" in row), {})
    wrong = asked.get("taken_for_matt")
    cost = "mirror images of the objects in the ground, and shadows that lie differently on a gloss"
    if wrong is not None:
        cost += f": {wrong:.1%} of their change, {asked['objects_of_matt']:.1%} of the light on objects (medians)"
        cost += "" if modelled else ", if the likeliest gloss were there"
    return {
        "term": "specular lobe of the ground",
        "modelled": modelled,
        "because": forced + (f"held-out log-likelihood: {scores}" if scores else surface.scores[0]["because"]),
        "could_cost": cost,
        **(
            {"no_bound": "no gloss was tried"}
            if wrong is None
            else {"bound_rel": wrong, "object_rel": asked["objects_of_matt"], **TRIED}
        ),
    }
