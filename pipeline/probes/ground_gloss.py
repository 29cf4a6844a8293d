"""A glossy ground shows the plate another mirror image than it shows the probe: the one is taken off, the other put in.

Below the horizon the map takes the plate's pixels, as if every place looked alike from everywhere. A coat or a polish
mirrors a window to the camera that it does not mirror to the probe. Whether the ground is glossy is asked as the
reflectance stage asks it (`pipeline.transport.specular`): cells of the plate that are held out, under the light from
above that the probe saw. The probe is a second witness: it sees the same places from another side, and must agree
better with the glossy ground than with the diffuse one. Then radiance is ``base * W + S`` with the fields of the lobe
in the direction of the viewer; the base of a place, from the plate, is seen again by the fields of the probe's
direction. Where the base would be negative the place is something matt that lies on the ground, and stays as it is.
What nobody saw is filled less its mirror image. Limits: one gloss for all of the ground; f0 of all channels alike;
light from above is distant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.camera.lens import project
from pipeline.conventions import direction_from_latlong, invert_rigid, latlong_directions, transform_points
from pipeline.light.sampling import bilinear, planes
from pipeline.probes.combine import Below
from pipeline.probes.filling import enlarge
from pipeline.run.evidence import TRIED
from pipeline.transport.patches import lights_of
from pipeline.transport.specular import FINE_MAP, cells_of, climb, explain, lobes, metal, rough
from pipeline.types import Camera, Surface

UP = np.array([0.0, 1.0, 0.0])
REACH = 8.0  # heights of the probe around its foot whose plate is asked, as far as the plate is laid under the map
TEXELS = 100  # along a side of what is asked
FIELD_ROWS = 64  # of a whole map, on which the lobe's fields are computed: 2.8 degrees, half of the narrowest lobe
LOBE_SIGMA = 0.3  # relative, of what is changed: its rms error on a coat that is none of the models, 0.31 measured
BLACK = -0.02  # of the median base: a base below is no noise of black ink
LEAST = 100  # texels that the probe must see itself to be a witness
EDGE = 0.99  # of a texel: laid and seen as a whole


@dataclass(frozen=True, eq=False)
class Gloss:
    """The ground's lobe. ``surface``: as the ladder has it; with diffuse the rest is not used.

    ``offset`` (H, W, 3): radiance that it mirrors to the probe, zero above the horizon. ``misfit``: median of the
    relative difference of the probe's own picture of the ground from the diffuse and from the glossy one, NaN without.
    """

    surface: Surface
    offset: np.ndarray
    below: Below
    misfit: tuple[float, float] = (np.nan, np.nan)

    @property
    def taken(self) -> bool:
        """Whether the map is changed."""
        return self.surface.model != "diffuse"


def assess(
    environment: np.ndarray, own: np.ndarray, seen: np.ndarray, below: Below, plate: np.ndarray, camera: Camera,
    world_from_camera: np.ndarray, centre: np.ndarray,
) -> Gloss:  # fmt: skip
    """What the ground mirrors. ``environment`` (H, W, 3): the map with the plate laid under it as ``below`` says.

    ``own`` (H, W, 3), ``seen`` (H, W): what the probe saw itself; ``plate`` (h, w, 7): RGB, variance RGB, valid.
    """
    nothing = np.zeros(environment.shape)
    surface = _ladder(environment, plate, camera, world_from_camera, centre)
    if surface.model == "diffuse":
        return Gloss(surface, nothing, below)
    height, width = environment.shape[:2]
    to_probe, to_camera = _fields(surface, environment, world_from_camera[:3, 3], centre)
    above = latlong_directions(height, width)[..., 1] >= 0
    offset = np.where(above[..., None], 0, enlarge(to_probe[1], height, width))
    again = _seen_again(below, *(enlarge(part, height, width) for part in (*to_probe, *to_camera)))
    misfit = _misfit(own, seen, below), _misfit(own, seen, again)
    if misfit[1] > misfit[0]:
        because = f"the probe sees the ground {misfit[1]:.0%} from the glossy one, {misfit[0]:.0%} from the diffuse one"
        return Gloss(Surface(scores=[{"model": "diffuse", "because": because}]), nothing, below, misfit)
    return Gloss(surface, offset, again, misfit)


def _ladder(
    environment: np.ndarray, plate: np.ndarray, camera: Camera, world_from_camera: np.ndarray, centre: np.ndarray
) -> Surface:
    """The surface that held-out cells of the plate around the probe's foot ask for."""
    step = (np.arange(TEXELS) + 0.5) / TEXELS * 2 - 1
    x, z = np.meshgrid(centre[0] + REACH * centre[1] * step, centre[2] + REACH * centre[1] * step)
    points = np.stack([x, 0 * x, z], -1)
    px = project(camera, transform_points(invert_rigid(world_from_camera), points.reshape(-1, 3))).reshape(*x.shape, 2)
    inside = np.isfinite(px).all(-1) & ((px > 1) & (px < (camera.width - 1, camera.height - 1))).all(-1)
    px = np.where(inside[..., None], px, 0.0)
    found = bilinear(planes(plate), px[..., 0], px[..., 1]).astype(float)
    known = inside & (found[..., 6] > 0.999)
    if not known.any():
        return Surface(scores=[{"model": "diffuse", "because": "the plate does not show the ground at the probe"}])
    cells = cells_of(found[..., :3], found[..., 3:6], known, points, world_from_camera[:3, 3])
    return climb(cells, environment, UP)


Pair = tuple[np.ndarray, np.ndarray]


def _fields(surface: Surface, environment: np.ndarray, eye: np.ndarray, centre: np.ndarray) -> tuple[Pair, Pair]:
    """W and S (h, w, 3) of a coarse map's places on the ground, towards the probe and towards the camera."""
    height = min(FIELD_ROWS, environment.shape[0])
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(2 * height) + 0.5) / (2 * height), indexing="ij")
    ways = direction_from_latlong(u, v)
    down = np.minimum(ways[..., 1:2], -0.01)  # at the horizon and above: of the farthest place
    ways = np.concatenate([ways[..., :1], down, ways[..., 2:]], -1).reshape(-1, 3)
    arm = eye - (centre - ways * (centre[1] / ways[:, 1])[:, None])
    views = [-ways / np.linalg.norm(ways, axis=1, keepdims=True), arm / np.linalg.norm(arm, axis=1, keepdims=True)]
    lights = lights_of(environment, FINE_MAP)
    found: list[Pair] = []
    for view in views:
        lobe = lobes(lights, UP, view, np.array([surface.roughness]))
        fields = metal(lobe) if surface.model == "metallic" else rough(lobe, np.array([surface.f0]))
        found.append(
            tuple(part[0].reshape(height, 2 * height, 3).astype(float) for part in (fields.scale, fields.offset))
        )
    return found[0], found[1]


def _seen_again(
    below: Below, scale: np.ndarray, offset: np.ndarray, camera_scale: np.ndarray, camera_offset: np.ndarray
) -> Below:
    """The laid plate (H, W, 3) as the probe sees it, and the variance that the lobe adds."""
    weight = np.maximum(camera_scale, 1e-12)
    base = (below.rgb - camera_offset) / weight
    ground = (below.share > 0) & (
        base > BLACK * np.median(below.rgb[below.share > EDGE] / weight[below.share > EDGE])
    ).all(-1)
    again = np.where(ground[..., None], np.maximum(base, 0) * scale + offset, below.rgb)
    variance = below.variance * np.where(ground[..., None], (scale / weight) ** 2, 1)
    return replace(below, rgb=again, variance=variance + (LOBE_SIGMA * (again - below.rgb)) ** 2)


def _misfit(own: np.ndarray, seen: np.ndarray, below: Below) -> float:
    """Median |ln| of what the probe saw (H, W, 3) over what is laid there; NaN where it saw too little of it.

    The probe's own shadow is in both figures alike.
    """
    both = (seen > EDGE) & (below.share > EDGE) & (own > 0).all(-1) & (below.rgb > 0).all(-1)
    if both.sum() < LEAST:
        return np.nan
    return float(np.median(np.abs(np.log(own[both] / below.rgb[both]))))


def mirrored_variance(gloss: Gloss, known: np.ndarray) -> np.ndarray:
    """Variance (H, W, 3) of the mirror images in what was filled, by the share ``known`` (H, W) that was not."""
    return np.asarray(((1 - known[..., None]) * LOBE_SIGMA * gloss.offset) ** 2)


def numbers(gloss: Gloss) -> dict[str, Any]:
    """Figures of the ground's gloss."""
    kept = {key: getattr(gloss.surface, key) for key in ("model", "roughness", "f0")} if gloss.taken else {}
    return {"ground_gloss": {"model": "diffuse"} | kept | {"probe_misfit_diffuse_glossy": list(gloss.misfit)}}


def reason(gloss: Gloss) -> dict[str, Any]:
    """Whether the ground is taken for glossy below the horizon, and why."""
    said = str(explain(gloss.surface)["because"])
    if gloss.taken and np.isfinite(gloss.misfit[0]):
        said += (
            f"; the probe itself sees the ground {gloss.misfit[0]:.0%} from the diffuse one, {gloss.misfit[1]:.0%} "
            "from the glossy one, its own shadow in both"
        )
    return {
        "term": "mirror images in the ground, from the plate to the probe", "modelled": gloss.taken, "because": said,
        "could_cost": f"a lobe that is off by {LOBE_SIGMA:.0%}, which the variance has" if gloss.taken
        else "nothing on a matt ground; the light from below by what a gloss too faint to be found mirrors",
        "no_bound": "held-out cells do not tell it from none; the reflectance stage bounds what the plate shows of it",
        **TRIED,
    }  # fmt: skip
