"""The slow route to the albedo: differentiable path tracing of the local scene, fitted to the plate.

Mitsuba's path replay backpropagation (Vicini et al. 2021) differentiates every pixel's radiance by the albedo of the
plane's texels and of the proxies, Adam (Kingma and Ba 2015) descends on the squared relative error. No patches, so
bounces and contacts are as the path tracer has them; Monte Carlo noise takes the place of the patches' error. What is
fitted on the plane is a smooth factor on the texture it starts from: single texels are not resolved by the plate, and
would only take up noise. Residual and gradient come from different halves of the samples: the same half would add the
gradient of the variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.camera.lens import pixel_rays
from pipeline.conventions import CLIPPED
from pipeline.transport.ray_arrays import arrays_of_rays
from pipeline.transport.reflectance import linear
from pipeline.transport.scene import environment_emitter, ground_shape, ground_texture, proxy_shape
from pipeline.types import Camera, Occluder, Plane, Proxy, Raster, View

PIXELS = 12_000  # at most, of the plate's blocks that are fitted
TEXELS = 128  # along the longer side of the texture in the path tracer
CELLS = 32  # of the factor on it
SAMPLES = 16  # per block and step, an even number
DEPTH = 6
STEPS = 100
RATES = (0.03, 0.001)  # of Adam, at the first and at the last step
FLOOR = 0.05  # of the median radiance: below it errors count as absolute ones
LOWEST, HIGHEST = 0.002, 0.98


@dataclass(frozen=True, eq=False)
class Fit:
    """Factor (h, w, 3) on the plane's albedo in cells, albedo (3,) of each proxy, and the loss of every step."""

    factor: np.ndarray
    proxies: list[np.ndarray]
    loss: list[float]


def blocks(plate: Raster, camera: Camera) -> tuple[np.ndarray, np.ndarray, int]:
    """Mean radiance (N, 3) of square blocks of pixels without clipped ones, their corners (N, 2) px, their side px."""
    rgb = plate.rgb().astype(float)
    size = int(np.ceil(np.sqrt(camera.width * camera.height / PIXELS)))
    rows, columns = camera.height // size, camera.width // size
    part = (slice(0, rows * size), slice(0, columns * size))
    good = np.isfinite(rgb).all(-1) & ((plate["mask"] & CLIPPED) == 0)
    whole = good[part].reshape(rows, size, columns, size).all((1, 3))
    mean = np.where(good[..., None], rgb, 0.0)[part].reshape(rows, size, columns, size, 3).mean((1, 3))
    row, column = np.nonzero(whole)
    return mean[row, column], np.stack([column, row], -1) * float(size), size


def scene_with(
    mi: Any, plane: Plane, texture: np.ndarray, proxies: Sequence[Proxy], albedos: Sequence[np.ndarray],
    occluders: Sequence[Occluder], environment: np.ndarray,
) -> Any:  # fmt: skip
    """The local scene with an albedo texture (h, w, 3) of the plane and one albedo for each proxy."""
    ground = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": ground_texture(mi, texture)}}
    shapes = {"ground": mi.load_dict(ground_shape(plane, ground))}
    for number, (proxy, albedo) in enumerate(zip(proxies, albedos)):
        shapes[f"proxy_{number:03d}"] = proxy_shape(mi, proxy, albedo)
    for number, occluder in enumerate(o for o in occluders if o.vertices_m is not None):
        shapes[f"occluder_{number:03d}"] = proxy_shape(mi, occluder, np.zeros(3))
    return mi.load_dict({"type": "scene", "distant": environment_emitter(mi, environment), **shapes})


def fit(
    plane: Plane, start: np.ndarray, proxies: Sequence[Proxy], occluders: Sequence[Occluder],
    environment: np.ndarray, plate: Raster, camera: Camera, view: View, steps: int = STEPS, seed: int = 0,
) -> Fit:  # fmt: skip
    """Albedo that makes the path-traced local scene the plate.

    ``start`` (H, W, 3): the plane's albedo to begin with; proxies begin with theirs. Where no pixel asks for a change
    the factor stays 1. The answer is the mean over the last quarter of ``steps``.
    """
    mi = arrays_of_rays("reflectance: gradients")
    import drjit as dr

    albedos = [np.full(3, 0.5) if proxy.albedo is None else np.asarray(proxy.albedo) for proxy in proxies]
    start = np.clip(coarse(start), LOWEST, HIGHEST)
    spread = [spreading(size, -(-size * CELLS // max(start.shape[:2]))) for size in start.shape[:2]]
    scene = scene_with(mi, plane, start, proxies, albedos, occluders, environment)
    parameters = mi.traverse(scene)
    keys = sorted(key for key in parameters.keys() if key.endswith("reflectance.data"))  # noqa: SIM118
    ground = next(key for key in keys if "ground" in key)
    others = sorted(key for key in keys if "proxy" in key)
    optimizer = mi.ad.Adam(lr=RATES[0])
    optimizer["factor"] = mi.TensorXf(np.ones((spread[0].shape[1], spread[1].shape[1], 3), np.float32))
    for key in others:
        optimizer[key] = parameters[key]
    parameters.update(optimizer)
    dr.enable_grad(parameters[ground])
    parameters.update()
    target, corner, size = blocks(plate, camera)
    floor = FLOOR * np.median(target.sum(-1)) / 3
    integrator = mi.load_dict({"type": "prb", "max_depth": DEPTH, "hide_emitters": True})
    rng = np.random.default_rng(seed)
    losses, kept = [], []
    for step in range(steps):
        optimizer.set_learning_rate(RATES[0] * (RATES[1] / RATES[0]) ** (step / max(steps - 1, 1)))
        ray = _rays(mi, camera, view, corner, size, rng)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed * 100_003 + step, len(target) * SAMPLES)
        with dr.suspend_grad():
            light, valid, _, state = integrator.sample(
                dr.ADMode.Primal, scene, sampler.clone(), ray, None, None, mi.Bool(True)
            )
            found = np.array(light).T.reshape(len(target), 2, SAMPLES // 2, 3).mean(2)
            whole: np.ndarray = np.all(np.array(valid).reshape(len(target), SAMPLES), axis=1)
            scale = np.where(whole[:, None], 1 / (target + floor) ** 2, 0.0)
            residual = found[:, ::-1] - target[:, None]  # each half is driven by the other's
            losses.append(float(((found.mean(1) - target) ** 2 * scale).sum() / max(3 * whole.sum(), 1)))
            weight = np.repeat(2 * residual * scale[:, None], SAMPLES // 2, 1).reshape(-1, 3) / target.size / SAMPLES
            adjoint = mi.Color3f(np.ascontiguousarray(weight.T, np.float32))
            integrator.sample(dr.ADMode.Backward, scene, sampler, ray, adjoint, state, mi.Bool(True))
        slope = np.array(dr.grad(parameters[ground])).reshape(start.shape) * start
        dr.set_grad(optimizer["factor"], mi.TensorXf(np.float32(both(spread[0].T, spread[1].T, slope))))
        optimizer.step()
        for key in others:
            optimizer[key] = dr.clip(optimizer[key], LOWEST, HIGHEST)
        parameters.update(optimizer)
        factor = np.array(optimizer["factor"], float)
        texture = np.clip(start * both(spread[0], spread[1], factor), LOWEST, HIGHEST)
        parameters[ground] = mi.TensorXf(np.float32(texture.reshape(np.array(parameters[ground]).shape)))
        dr.enable_grad(parameters[ground])
        parameters.update()
        if step >= steps - max(1, steps // 4):
            kept.append([factor, *(np.array(parameters[key], float).reshape(-1, 3).mean(0) for key in others)])
    means = [np.mean(values, 0) for values in zip(*kept)]
    return Fit(means[0], means[1:], losses)


def spreading(fine: int, cells: int) -> np.ndarray:
    """(fine, cells) linear interpolation between the centres of cells along one axis, the border repeated."""
    return linear(np.eye(cells), (np.arange(fine) + 0.5) / fine * cells - 0.5, 0)


def both(rows: np.ndarray, columns: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A matrix applied along each of the two axes of values (h, w, 3)."""
    return np.einsum("ah,hwc,bw->abc", rows, values, columns, optimize=True)


def _rays(mi: Any, camera: Camera, view: View, corner: np.ndarray, size: int, rng: np.random.Generator) -> Any:
    """SAMPLES rays through random places of every block, in the order of the blocks."""
    px = np.repeat(corner, SAMPLES, 0) + size * rng.uniform(size=(len(corner) * SAMPLES, 2))
    direction = pixel_rays(camera, px) @ view.world_from_camera[:3, :3].T
    origin = np.broadcast_to(view.world_from_camera[:3, 3], direction.shape)
    vectors = [np.ascontiguousarray(part.T, np.float32) for part in (origin, direction)]
    return mi.Ray3f(mi.Point3f(vectors[0]), mi.Vector3f(vectors[1]))


def coarse(texture: np.ndarray, longest: int = TEXELS) -> np.ndarray:
    """A texture (H, W, 3) averaged to at most ``longest`` texels along its longer side."""
    size = -(-max(texture.shape[:2]) // longest)
    height, width = (-(-n // size) for n in texture.shape[:2])
    rows, columns = (
        np.minimum(np.arange(n * size), m - 1) for n, m in ((height, texture.shape[0]), (width, texture.shape[1]))
    )
    return texture[rows[:, None], columns[None]].reshape(height, size, width, size, 3).mean((1, 3))
