"""Less noise in what was rendered, never in the photograph, and never more than without.

Samples come in two independent halves of equal number, A and B. Each is denoised by Open Image Denoise alone, so the
other half, which knows nothing of its noise, tells the error of the result: with the truth T and d(A) denoised,

    E (d(A) - B)^2 = E (d(A) - T)^2 + var B,      E (A - B)^2 = var A + var B

(cross-validation; the same idea with one sample buffer against another: Rousselle, Knaus and Zwicker, *Adaptive
Rendering with Non-Local Means Filtering*, 2012). Means over a small window of these squares give the mean squared error
of the denoised mean, of the raw mean, and of everything between, without knowing any variance: points of low
discrepancy make the variance of samples an overestimate, the pair is right for them too. The result is the mixture of
least error (`blended`). Where the denoiser loses a highlight or blurs a caustic, the samples themselves remain.

What is denoised is free of the ground's texture: lost and gained light relative to LS_noobj. `quieted` arranges the
three signals at the least cost that measured no worse (docs/method.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Pair = tuple[np.ndarray, np.ndarray]  # of the halves

CLIPPED_SHARE = 1e-3  # of the ground's pixels, whose surviving light the denoiser may see cut off at zero
MARGIN = 16  # px of surroundings given to the denoiser
TILE = 8  # px, side of the tiles on which noise is told
WINDOW = 16  # px, side of the window of the error estimates
SPECKLE_GAIN = 4.0  # a pixel may exceed what its surroundings and the other half show by this factor
SPECKLE_SCALES = (2.0, 5.0, 12.0)  # px, standard deviations over which the excess goes
SPECKLES_TOGETHER = 2  # in each half, so many speckles must overlap at a scale
FAINT_SPECKLE = 1 / 12  # bound over value: spread over 12 px, the glow stays below 5 % of what the surroundings show
LINEAR_SRGB = 0.0031308  # of display white, below which the curve of IEC 61966-2-1 is a line


@dataclass(frozen=True, eq=False)
class Half:
    """One of two independent estimates of the same pixels, each (H, W, 3), radiance, means over the samples."""

    lost: np.ndarray  # <= 0, carries the share of the pixel left to the local scene
    gained: np.ndarray  # >= 0, likewise
    without: np.ndarray  # LS_noobj, likewise; from the same camera samples, so that texture cancels in the ratio
    obj: np.ndarray  # object layer, premultiplied


@dataclass(frozen=True, eq=False)
class Quiet:
    """One signal after `blended`."""

    rgb: np.ndarray  # (H, W, 3)
    noise: np.ndarray  # (h, w) estimated RMS error, bias of the denoiser included, per tile; in units of rgb
    raw_share: float  # weight of the samples themselves in the mixture, mean over the support
    speckle_share: float  # light that `spread_speckles` took from pixels, over all light
    held_back: float  # of that, what went nowhere, over all light
    moved: np.ndarray  # (h, w) what `spread_speckles` changed in the mean of each tile


@dataclass(frozen=True, eq=False)
class QuietChange:
    """What the objects change, quieted: ``lost = (survives - 1) * without``, ``gained = added * without``."""

    survives: Quiet  # light of LS_noobj that is left, relative to it
    added: Quiet  # light that objects add, relative to LS_noobj
    obj: Quiet  # object layer, premultiplied radiance
    ground: np.ndarray  # (h, w) share of each tile that shows the local scene
    cover: np.ndarray  # (h, w) share that shows objects

    def noise(self, level: np.ndarray) -> np.ndarray:
        """(h, w) RMS error of the composite per tile [radiance] on a plate whose tile means are ``level`` (h, w)."""
        relative = np.hypot(self.survives.noise, self.added.noise) * level
        return np.sqrt(self.ground * relative**2 + self.cover * self.obj.noise**2)


def tile_means(values: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Means of (H, W) over tiles of 8 x 8 pixels, those at the right and lower border cut; zero without weight."""
    weight = np.ones(values.shape) if weight is None else weight
    rows, columns = (np.arange(0, size, TILE) for size in values.shape)
    total = np.add.reduceat(np.add.reduceat(values * weight, rows, 0), columns, 1)
    whole = np.add.reduceat(np.add.reduceat(weight, rows, 0), columns, 1)
    return np.divide(total, whole, out=np.zeros_like(total), where=whole > 0)


def brightest(rgb: np.ndarray) -> np.ndarray:
    """(H, W) largest channel; three times as quick as ``rgb.max(-1)``."""
    return np.maximum(np.maximum(rgb[..., 0], rgb[..., 1]), rgb[..., 2])


def spread_speckles(half_a: np.ndarray, half_b: np.ndarray, support: np.ndarray) -> Pair:
    """Isolated bright pixels give their excess to their surroundings, or keep it back until there is more evidence.

    A pixel is a speckle where it exceeds four times both the median of its 3 x 3 pixels and the brightest of them
    *in the other half*: a highlight that both halves see is left alone, however small. The excess goes to a Gaussian,
    as narrow as lets two speckles *of each half* overlap, at most 12 px wide: a sparsely sampled caustic becomes an
    even one. What finds no such company goes to 12 px too where that glow is faint; else it is held back: one path does
    not tell where its light belongs. The bias is bounded and counted: no light goes further than 48 px or off the
    support; a tile loses at most the excess of its own speckles (`Quiet.moved`, `Quiet.held_back`); halves that agree
    within a factor of four are not touched at all, so it vanishes with more samples. Of few samples chance makes
    speckles of both halves meet, which then stay, and the samples of their window with them: at draft 9 of the 50 000
    pixels about desk's gold ring keep over 30 % of LS_noobj too much added light (both halves near 1, the denoised
    0.1), 0.8 % of all that is added there; at preview none.

    Args:
        half_a: (H, W, 3) float32, >= 0.
        half_b: the same, independent.
        support: (H, W) float32 in [0, 1], the pixels that can carry light of this signal.
    """
    import cv2

    halves, levels = (half_a, half_b), (brightest(half_a), brightest(half_b))
    kept = []
    for own, other in (levels, levels[::-1]):
        bound = SPECKLE_GAIN * np.maximum(cv2.medianBlur(own, 3), cv2.dilate(other, np.ones((3, 3), np.uint8)))
        kept.append(np.divide(bound, own, out=np.ones_like(own), where=(own > bound) & (support > 0)))
    speckles = [(share < 1).astype(np.float32) for share in kept]
    waiting = (speckles[0] + speckles[1]) > 0
    if not waiting.any():
        return half_a, half_b
    results = [half * share[..., None] for half, share in zip(halves, kept, strict=True)]
    for scale in SPECKLE_SCALES:
        overlap = np.minimum(blur(speckles[0], scale), blur(speckles[1], scale)) * 2 * np.pi * scale**2
        faint = (np.minimum(*kept) > FAINT_SPECKLE) & (scale == SPECKLE_SCALES[-1])
        now = waiting & ((overlap >= SPECKLES_TOGETHER) | faint)
        waiting &= ~now
        if now.any():
            # Divided by what a kernel finds of the support, multiplied by the support: nothing falls off it.
            reach = 1 / np.maximum(blur(support, scale), 1e-6)
            for half, share, result in zip(halves, kept, results, strict=True):
                going = half * ((1 - share) * now)[..., None]
                if total := going.sum(dtype=float):
                    there = blur(going * reach[..., None], scale) * support[..., None]
                    result += there * np.float32(total / there.sum(dtype=float))
    return results[0], results[1]


def blur(values: np.ndarray, scale: float) -> np.ndarray:
    """Gaussian of (H, W, ...) out to four standard deviations, mirrored at the border; wide ones on pixels of 4 x 4."""
    import cv2

    if scale <= 4:
        size = 2 * int(4 * scale) + 1
        return cv2.GaussianBlur(values, (size, size), scale, borderType=cv2.BORDER_REFLECT)
    height, width = values.shape[:2]
    small = cv2.resize(values, (-(-width // 4), -(-height // 4)), interpolation=cv2.INTER_AREA)
    return cv2.resize(blur(small, scale / 4), (width, height), interpolation=cv2.INTER_LINEAR)


def oidn(
    rgb: np.ndarray, albedo: np.ndarray | None = None, normal: np.ndarray | None = None, fast: bool = False
) -> np.ndarray:
    """Open Image Denoise on linear values (H, W, 3), those below zero taken as zero.

    Args:
        rgb: what is noisy.
        albedo: (H, W, 3) in [0, 1], an edge guide with little noise of its own.
        normal: (H, W, 3) in [-1, 1], a second guide; costs nothing.
        fast: the smaller network: half the cost.
    """
    import mitsuba_oidn

    guides = {}
    if albedo is not None:
        guides["albedo"] = np.ascontiguousarray(np.clip(albedo, 0, 1), np.float32)
    if normal is not None:
        guides["normal"] = np.ascontiguousarray(normal, np.float32)
    quality = mitsuba_oidn.Quality.Fast if fast else mitsuba_oidn.Quality.High
    result = mitsuba_oidn.denoise(
        np.ascontiguousarray(np.maximum(rgb, 0), np.float32), hdr=True, quality=quality, **guides
    )
    return np.maximum(result, 0)


def denoise(rgb: np.ndarray, albedo: np.ndarray, normal: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """One picture (H, W, 3) of which there are no halves, and the share of its light held back."""
    noisy = np.asarray(rgb, np.float32)
    calm, _ = spread_speckles(noisy, np.zeros_like(noisy), np.ones(noisy.shape[:2], np.float32))
    total = float(noisy.sum(dtype=float))
    return oidn(calm, albedo, normal), float((noisy - calm).sum(dtype=float)) / total if total > 0 else 0.0


def blended(
    raw: Pair,
    calm: Pair,
    smooth: Pair,
    support: np.ndarray,
    white: float,
) -> Quiet:
    """The mixture of denoised and raw means that has the least error, and an estimate of that error.

    With e the error of the denoised mean d and f that of the raw mean r, the error of d + k (r - d) is least at
    k = E e (e - f) / E (r - d)^2. From the halves, all per window: E (r - d)^2 is seen; E f^2 = E (A - B)^2 / 4; and
    E e^2 = E [(d(A) - B)^2 + (d(B) - A)^2 - (A - B)^2] / 2 - E (d(A) - d(B))^2 / 4. The squares of the halves' own
    noise cancel sample by sample in that sum, which leaves products of independent errors: heavy tails do it no harm.

    Args:
        raw: the two halves as traced, each (H, W, 3); only for the count of what was moved.
        calm: after `spread_speckles`.
        smooth: each half of ``calm``, denoised alone.
        support: (H, W) in [0, 1], weight of each pixel.
        white: errors count relative to the value where that is brighter, so that no highlight decides for its window.
    """
    import cv2

    (a, b), (da, db) = calm, smooth
    mean, den = (a + b) / 2, (da + db) / 2
    weight = support / np.maximum(1, brightest(den) / white) ** 2
    grey = np.full(3, 1 / 3, np.float32)

    def box(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT)

    whole = np.maximum(box(weight), 1e-12)

    def window(squares: np.ndarray) -> np.ndarray:
        return np.maximum(box(squares @ grey * weight), 0) / whole  # running sums may end below zero

    twins = window((da - db) ** 2) / 4
    sampling = window((a - b) ** 2) / 4
    error = (window((da - b) ** 2) + window((db - a) ** 2)) / 2 - 2 * sampling - twins
    apart = window((mean - den) ** 2)
    share = np.divide(error - sampling + apart, 2 * apart, out=np.zeros_like(apart), where=apart > 0)
    share = np.clip(share, 0, 1)
    mixed = error + share * (sampling - error - apart) + share**2 * apart
    # The estimate may fall below zero by its own noise; what the two results differ by is a floor that cannot.
    differ = window(((da - db) + share[..., None] * ((a - b) - (da - db))) ** 2) / 4
    total = max(float(np.abs(raw[0] + raw[1]).sum(dtype=float)), 1e-30)
    less = raw[0] - a, raw[1] - b
    taken = sum(float(np.maximum(part, 0).sum(dtype=float)) for part in less)
    return Quiet(
        rgb=den + share[..., None] * (mean - den),
        noise=np.sqrt(tile_means(np.maximum(mixed, differ), support)),
        raw_share=float((share * support).sum() / max(support.sum(), 1e-12)),
        speckle_share=taken / total,
        held_back=sum(float(part.sum(dtype=float)) for part in less) / total,
        moved=tile_means((less[0] + less[1]) @ grey / -2),
    )


def continued(picture: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Pixels of (H, W, 3) that are not ``known`` (H, W) take the value of the nearest that is."""
    import cv2

    if known.all() or not known.any():
        return picture
    unknown = np.where(known, 0, 1).astype(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    owner = np.zeros(labels.max() + 1, int)
    owner[labels[known]] = np.flatnonzero(known)
    result = picture.copy()
    result[~known] = picture.reshape(-1, 3)[owner[labels[~known]]]
    return result


def denoised_small(rgb: np.ndarray, fast: bool) -> np.ndarray:
    """Denoised at half the resolution: a quarter of the cost, for what is smooth."""
    import cv2

    height, width = rgb.shape[:2]
    small = cv2.resize(rgb, ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA)
    return cv2.resize(oidn(small, fast=fast), (width, height), interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True, eq=False)
class _Signals:
    """What the two halves say, free of the ground's texture, speckles spread; and how the denoiser sees it."""

    survives: Pair
    added: Pair
    objects: Pair
    calm_survives: Pair
    calm_added: Pair
    calm_objects: Pair
    cover: np.ndarray
    ground: np.ndarray
    level: np.float32
    lift: np.float32  # what is added to surviving light so that the denoiser, which clips at zero, sees its noise whole
    albedo: np.ndarray
    normal: np.ndarray

    def drawn(self, survives: np.ndarray, obj: np.ndarray, fast: bool) -> tuple[np.ndarray, np.ndarray]:
        """Surviving light with the objects drawn over it, denoised in one picture and taken apart again."""
        shown, full = self.cover >= 0.5, np.maximum(self.cover, 1e-3)[..., None]
        picture = np.where(shown[..., None], obj / (full * self.level), survives + self.lift)
        calm = oidn(picture, self.albedo, self.normal, fast)
        left = np.maximum(continued(calm, ~shown) - self.lift, 0)
        return left, continued(calm, shown) * self.level * self.cover[..., None]


def _signals(
    half_a: Half, half_b: Half, alpha: np.ndarray, obj_albedo: np.ndarray, obj_normal: np.ndarray, white: float
) -> _Signals:
    halves = [Half(*(np.asarray(v, np.float32) for v in vars(half).values())) for half in (half_a, half_b)]
    bare = np.minimum(*(half.without.min(-1) for half in halves)) > 0
    cover = np.clip(alpha, 0, 1).astype(np.float32)
    ground = (1 - cover) * bare

    def relative(name: str) -> Pair:
        # Below an object the ground's values continue, so that its outline is no edge of theirs.
        parts = [
            np.divide(getattr(half, name), half.without, out=np.zeros_like(half.obj), where=bare[..., None])
            for half in halves
        ]
        return continued(parts[0], bare), continued(parts[1], bare)

    lost, added = relative("lost"), relative("gained")
    objects = (halves[0].obj, halves[1].obj)
    dim, calm_added, calm_objects = (
        spread_speckles(*pair, mask)
        for pair, mask in (((-lost[0], -lost[1]), ground), (added, ground), (objects, cover))
    )
    shown, full = cover >= 0.5, np.maximum(cover, 1e-3)[..., None]
    return _Signals(
        survives=(1 + lost[0], 1 + lost[1]),
        added=added,
        objects=objects,
        calm_survives=(1 - dim[0], 1 - dim[1]),
        calm_added=calm_added,
        calm_objects=calm_objects,
        cover=cover,
        ground=ground,
        level=np.float32(np.median(halves[0].without[bare]) if bare.any() else white),
        lift=lifted(dim, ground),
        albedo=np.where(shown[..., None], obj_albedo / full, 1.0),
        normal=np.where(shown[..., None], obj_normal / full, 0.0),
    )


def lifted(dim: Pair, ground: np.ndarray) -> np.float32:
    """How far below zero surviving light goes by its noise in either half, but for `CLIPPED_SHARE` of the pixels.

    Few samples of a glossy ground find more light lost than there is; a clipped mean would be too bright, and the
    denoised picture worse than the raw one.
    """
    seen = ground > 0
    if not seen.any():
        return np.float32(0)
    most = (np.quantile(brightest(half)[seen], 1 - CLIPPED_SHARE) for half in dim)
    return np.float32(max(*most, 1.0) - 1)


def quieted(
    half_a: Half, half_b: Half, alpha: np.ndarray, obj_albedo: np.ndarray, obj_normal: np.ndarray, white: float
) -> QuietChange:
    """Surviving and added light and the object layer, speckles spread, denoised where that is better.

    Two calls of the denoiser per half: surviving light with the objects drawn over it in one picture, each pixel
    showing what covers most of it; added light at half the resolution. Both measured no worse than three calls in full.

    Args:
        half_a: one half of the samples; crop to `bounding_window` first, cost goes with the area.
        half_b: the other.
        alpha: (H, W) share of each pixel that objects cover, of both halves.
        obj_albedo: (H, W, 3) base colour of the objects, premultiplied.
        obj_normal: (H, W, 3) shading normal of the objects, premultiplied.
        white: radiance of display white.
    """
    s = _signals(half_a, half_b, alpha, obj_albedo, obj_normal, white)
    first, second = (s.drawn(rest, obj, False) for rest, obj in zip(s.calm_survives, s.calm_objects, strict=True))
    smooth_added = (denoised_small(s.calm_added[0], False), denoised_small(s.calm_added[1], False))
    return QuietChange(
        survives=blended(s.survives, s.calm_survives, (first[0], second[0]), s.ground, 1.0),
        added=blended(s.added, s.calm_added, smooth_added, s.ground, 1.0),
        obj=blended(s.objects, s.calm_objects, (first[1], second[1]), s.cover, white),
        ground=tile_means(s.ground),
        cover=tile_means(s.cover),
    )


def glimpsed(
    half_a: Half,
    half_b: Half,
    alpha: np.ndarray,
    obj_albedo: np.ndarray,
    obj_normal: np.ndarray,
    white: float,
    fast: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`quieted` of few samples, where halves are too noisy to judge a denoiser: surviving and added light and objects.

    The mean of both is denoised once: half the cost, and at 2 to 8 samples less error (docs/method.md). ``fast``: the
    smaller network, for pictures that will soon be replaced.
    """
    s = _signals(half_a, half_b, alpha, obj_albedo, obj_normal, white)
    survives, added, objects = ((pair[0] + pair[1]) / 2 for pair in (s.calm_survives, s.calm_added, s.calm_objects))
    calm, obj = s.drawn(survives, objects, fast)
    return calm, denoised_small(added, fast), obj


def needs_more(noise: np.ndarray, plate_sigma: np.ndarray, level: np.ndarray, white: float) -> np.ndarray:
    """Tiles (h, w) whose render is noisier than half of what the photograph hides.

    The photograph hides its own noise and the rounding of a displayed picture, one code of 255 of sRGB wide: standard
    deviation code / sqrt(12) times the slope of the curve, 0.27 % of white at white, 0.1 % at middle grey, 0.01 % in
    black. Rounding is the floor where the photograph has no noise.

    Args:
        noise: (h, w) RMS error of the composite per tile, radiance, e.g. `QuietChange.noise`.
        plate_sigma: (H, W) standard deviation of each pixel of the plate; not finite where unknown (clipped).
        level: (h, w) mean radiance of the composite per tile.
        white: radiance of display white; brighter tiles count as white.
    """
    known = np.isfinite(plate_sigma)
    own = tile_means(np.where(known, plate_sigma, 0) ** 2, known.astype(float))
    value = np.clip(level / white, 0, 1)
    code = np.where(value > LINEAR_SRGB, 1.055 * np.maximum(value, LINEAR_SRGB) ** (1 / 2.4) - 0.055, 12.92 * value)
    slope = np.where(value > LINEAR_SRGB, 2.4 / 1.055 * ((code + 0.055) / 1.055) ** 1.4, 1 / 12.92)
    rounding = slope * white / 255 / np.sqrt(12)
    return noise > 0.5 * np.sqrt(own + rounding**2)


def bounding_window(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns around True pixels of (H, W), with a margin; the whole when there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return slice(None), slice(None)
    return (
        slice(max(rows[0] - MARGIN, 0), rows[-1] + 1 + MARGIN),
        slice(max(columns[0] - MARGIN, 0), columns[-1] + 1 + MARGIN),
    )
