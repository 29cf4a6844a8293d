"""Lamps drawn as wide as they are, on maps whose lamps and whose spread are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from pipeline.conventions import latlong_directions, latlong_solid_angles
from pipeline.light import narrowing
from pipeline.light.alike import ADDED_PX2, ALIKE, ALIKE_PX, ALIKE_VIEWS, SOFT
from pipeline.light.emitters import Sky
from pipeline.light.environment import AXES, irradiance
from pipeline.types import Raster
from stages import knobs
from stages import lights as room

HEIGHT, WIDTH = 256, 512
TEXEL = np.pi / HEIGHT
BASE = 0.2
SPREAD = np.radians(1.4)
WAYS, SOLID = latlong_directions(HEIGHT, WIDTH), latlong_solid_angles(HEIGHT, WIDTH)


def unit(vector) -> np.ndarray:
    return np.asarray(vector, float) / np.linalg.norm(vector)


def shown(where, half_axes, spread: float, light: float = 30.0) -> np.ndarray:
    """A map (H, W, 3) of a uniform ellipse through a Gaussian of ``spread``, over an even sky."""
    centre = unit(where)
    across = np.cross(centre, [0.0, 1, 0])
    across /= np.linalg.norm(across)
    over = np.cross(centre, across)
    r, turn = np.sqrt((np.arange(400) + 0.5) / 400), np.pi * (3 - np.sqrt(5)) * np.arange(400)
    rgb = np.zeros((HEIGHT, WIDTH))
    near = centre @ np.moveaxis(WAYS, -1, 0).reshape(3, -1) > np.cos(max(half_axes) + 6 * spread)
    x, y = WAYS.reshape(-1, 3)[near] @ across, WAYS.reshape(-1, 3)[near] @ over
    for u, v in zip(half_axes[0] * r * np.cos(turn), half_axes[1] * r * np.sin(turn), strict=True):
        rgb.reshape(-1)[near] += np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / spread**2)
    energy = light * np.pi * half_axes[0] * half_axes[1]
    return BASE + rgb[..., None] * energy / (rgb * SOLID).sum() * np.array([1.0, 0.9, 0.7])


def of_picture(rgb: np.ndarray, spread: float) -> Raster:
    """As from a probe whose picture spreads points by ``spread`` [rad]; 5 % unsure."""
    degrees = np.degrees(spread) / narrowing.SPREAD_PX * ALIKE_PX
    variance = Raster.split((0.05 * rgb).astype(np.float32) ** 2, "variance")
    channels = {**Raster.split(rgb.astype(np.float32)), **variance, "seen": np.ones(rgb.shape[:2], np.float32)}
    return Raster(channels, "acescg", {ALIKE: f"{degrees:.6g}"})


def told_how_soft(picture: Raster, spread: float, soft_px: float, views: float) -> Raster:
    """As from pictures whose lens and pixel are ``soft_px``, of such pixels that a point becomes ``spread`` [rad]."""
    pixel = np.sqrt((spread**2 - TEXEL**2 / 6) / (soft_px**2 + ADDED_PX2))
    header = {ALIKE: f"{np.degrees(pixel) * ALIKE_PX:.6g}", ALIKE_VIEWS: f"{views}", SOFT: f"{soft_px}"}
    return Raster(picture.channels, "acescg", header)


def half_axes_of(raster: Raster, lamp) -> np.ndarray:
    """Half axes [rad], ascending, of the uniform ellipse of the moments of what a lamp's texels show above the sky."""
    rows, columns = raster.shape
    texels, direction = np.asarray(lamp.texels, int), lamp.direction
    ways = latlong_directions(rows, columns).reshape(-1, 3)[texels]
    energy = (raster.rgb().reshape(-1, 3)[texels, 1] - BASE * 0.9) * latlong_solid_angles(rows, columns).ravel()[texels]
    moved = ways - (ways @ direction)[:, None] * direction
    return 2 * np.sqrt(
        np.maximum(np.linalg.eigvalsh(np.einsum("n,ni,nj->ij", energy, moved, moved))[1:] / energy.sum(), 0)
    )


@pytest.mark.parametrize("where", [(0.4, 0.8, 0.45), (0.1, 0.3, -1.0), (0.02, 1.0, 0.03)])
def test_a_lamp_has_its_true_width_and_all_its_light(where):
    """2 degrees seen as 3.4: to 4 %, which is a tail of the blur below the level at which the patch ends."""
    true = np.radians(2.0)
    picture = of_picture(shown(where, (true, true), SPREAD), SPREAD)
    result = room.compute(picture, knobs.Lights())
    (lamp,), lit = result.outputs["emitters"], result.outputs["lighting"]
    assert np.degrees(lamp.half_angle_rad) == pytest.approx(2.0, rel=0.04)
    assert half_axes_of(lit, lamp) == pytest.approx(np.full(2, lamp.half_angle_rad), abs=0.2 * TEXEL)
    assert irradiance(lit.rgb(), lamp.direction[None])[0] == pytest.approx(
        irradiance(picture.rgb(), lamp.direction[None])[0], rel=1e-3
    )
    assert irradiance(lit.rgb(), AXES) == pytest.approx(irradiance(picture.rgb(), AXES), rel=5e-3, abs=0.01)
    assert lamp.direction @ unit(where) > np.cos(0.1 * TEXEL)
    (row,) = [row for row in result.evidence if "width" in row["term"]]
    assert row["modelled"]
    assert "half angle 3.4" in row["because"]


@pytest.mark.parametrize("soft_px", [0.55, 0.85])
def test_how_soft_the_picture_is_tells_the_width_and_makes_it_surer(soft_px):
    """Pixels of 1.2 or 1.0 degrees, of which a lens makes 1.4: the same lamp of 2 degrees; to 4 % as above."""
    picture = of_picture(shown((0.4, 0.8, 0.45), np.radians([2.0, 2.0]), SPREAD), SPREAD)
    known = told_how_soft(picture, SPREAD, soft_px, views=2.0)
    (lamp,) = room.compute(known, knobs.Lights()).outputs["emitters"]
    assert np.degrees(lamp.half_angle_rad) == pytest.approx(2.0, rel=0.04)
    assert narrowing.spread_sigma_of(known) == pytest.approx(narrowing.LAMP_SIGMA / np.sqrt(2))
    (unsure,) = room.compute(picture, knobs.Lights()).outputs["emitters"]
    assert lamp.half_angle_sigma_rad < 0.7 * unsure.half_angle_sigma_rad


def test_a_long_lamp_stays_long():
    """6 by 1 degrees: each axis loses the spread; the narrow one is known to a texel."""
    axes = np.radians([1.0, 6.0])
    result = room.compute(of_picture(shown((0.4, 0.8, 0.45), axes[::-1], SPREAD), SPREAD), knobs.Lights())
    (lamp,) = result.outputs["emitters"]
    found = half_axes_of(result.outputs["lighting"], lamp)
    assert found[1] == pytest.approx(axes[1], rel=0.04)
    assert found[0] == pytest.approx(axes[0], abs=TEXEL)


def test_a_lamp_that_the_picture_resolves_keeps_its_shape():
    """A square of 12 degrees through half a degree of spread stays a square: its corners stay bright."""
    side, spread = np.radians(6.0), np.radians(0.4)
    centre = unit((0.4, 0.6, 0.5))
    across = unit(np.cross(centre, [0.0, 1, 0]))
    over = np.cross(centre, across)
    edges = [ndtr((side - np.abs(WAYS @ way)) / spread) for way in (across, over)]
    square = BASE + 20 * edges[0] * edges[1] * (WAYS @ centre > 0)
    result = room.compute(of_picture(square[..., None] * np.ones(3), spread), knobs.Lights())
    (lamp,), lit = result.outputs["emitters"], result.outputs["lighting"]
    rows, columns = lit.shape
    corner = unit(centre + 0.85 * np.tan(side) * (across + over))
    ways = latlong_directions(rows, columns)
    assert lit["G"].ravel()[np.argmax((ways @ corner).ravel())] > 15
    aside = unit(centre + 1.2 * np.tan(side) * across)  # inside of the disc of its moments, outside of the square
    assert lit["G"].ravel()[np.argmax((ways @ aside).ravel())] < 1
    assert lamp.half_angle_rad > np.radians(6.5)


def test_what_is_recovered_or_clipped_or_of_no_picture_stays():
    rgb = shown((0.4, 0.8, 0.45), np.radians([2.0, 2.0]), SPREAD)
    picture = of_picture(rgb, SPREAD)
    (lamp,) = room.compute(picture, knobs.Lights(width="seen")).outputs["emitters"]
    for other in (lamp.model_copy(update={"evidence": word}) for word in ("recovered", "clipped")):
        same = narrowing.drawn(picture, [other], SPREAD)
        assert same.environment is picture
        assert same.emitters == [other]
    bare = room.compute(Raster(picture.channels, "acescg"), knobs.Lights())
    assert (bare.outputs["lighting"].rgb() == picture.rgb()).all()
    assert bare.outputs["emitters"][0].half_angle_sigma_rad == 0
    assert not [row for row in bare.evidence if "width" in row["term"]]
    forced = room.compute(picture, knobs.Lights(width="seen")).evidence
    (row,) = [row for row in forced if "width" in row["term"]]
    assert not row["modelled"]
    assert 0 < row["bound_rel"] < 0.5


def test_a_point_stays_within_a_few_texels_and_is_unsure_by_what_the_blur_is():
    rgb = shown((0.4, 0.8, 0.45), np.radians([0.05, 0.05]), SPREAD, light=3e5)
    (lamp,) = room.compute(of_picture(rgb, 1.1 * SPREAD), knobs.Lights()).outputs["emitters"]
    assert lamp.half_angle_rad == 0
    assert lamp.half_angle_sigma_rad < np.radians(1.4)
    assert len(lamp.texels) <= 4


def test_variance_goes_with_the_light_and_the_rest_of_the_map_is_not_touched():
    picture = of_picture(shown((0.4, 0.8, 0.45), np.radians([3.0, 3.0]), SPREAD), SPREAD)
    result = room.compute(picture, knobs.Lights())
    (lamp,), lit = result.outputs["emitters"], result.outputs["lighting"]
    assert np.sqrt(lit.rgb("variance")) == pytest.approx(0.05 * lit.rgb(), rel=1e-3)
    away = WAYS @ lamp.direction < np.cos(np.radians(20))
    factor = lit.shape[0] // HEIGHT
    assert (lit.rgb()[::factor, ::factor][away] == picture.rgb()[away]).all()


def test_wider_lamps_keep_their_light():
    """Their width to a fifth of a texel: what texels add to the moments twice, as drawn and as read."""
    picture = of_picture(shown((0.4, 0.8, 0.45), np.radians([2.0, 2.0]), SPREAD), SPREAD)
    result = room.compute(picture, knobs.Lights())
    (lamp,), lit = result.outputs["emitters"], result.outputs["lighting"]
    assert 0 < lamp.half_angle_sigma_rad < 0.3 * lamp.half_angle_rad
    rgb, (wide,) = narrowing.widened(lit.rgb(), [lamp])
    up = lamp.direction[None]
    assert irradiance(rgb, up)[0] == pytest.approx(irradiance(lit.rgb(), up)[0], rel=1e-4)
    texels = np.asarray(wide.texels, int)
    patch = Sky(rgb - BASE * np.array([1.0, 0.9, 0.7])).patch(texels, 0.0)
    assert patch.half_angle_rad == pytest.approx(lamp.half_angle_rad + lamp.half_angle_sigma_rad, abs=0.2 * TEXEL)
