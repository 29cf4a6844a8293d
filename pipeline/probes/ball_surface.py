"""How a mirror ball reflects: given, measured from the plane that is seen directly and in the ball, or assumed.

Angle dependence is Schlick's with the tint of Kutz, Hasan and Edmondson 2021, as the metals of
`pipeline.transport.conductors`: from the reflectance head on and the edge tint. Three rungs: one number per channel;
Schlick (tint 1); a common tint. A rung is climbed only when blocks of the plane that were held out ask for it, since a
mirror of one reflectance is the simplest explanation and the plane covers few angles near the rim.

The plane need not be matte: gloss makes the ratio depend on the elevations under which ball and camera see a point.
When held-out blocks ask for it, that is a term of the fit, zero where both elevations agree. A window that the ground
mirrors to the camera alone is no function of elevations: the measurement is then as unsure as that was seen to make it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pipeline.probes.ball_pairs import Pairs
from pipeline.probes.glass import Glass
from pipeline.transport.conductors import GRAZING, preset, reflectance_at

GIVEN_SIGMA = 0.02  # relative, of numbers in a manifest: reflectances are quoted to a percent or two
ASSUMED_SIGMA = 0.10  # of chrome that nobody measured
METHOD_SIGMA = 0.004  # blur and demosaicking: rms error of a channel on six simulated captures, balls of 43 to 90 px
GLOSS_SIGMA = 0.22  # relative, by a ground that mirrors a window: 14, 21 and 28 % too low on a simulated capture
MIN_PAIRS, MIN_BLOCKS, SECTORS, BLOCK_PAIRS = 200, 6, 12, 8
MAX_PAIRS = 4000  # of all views: more are thinned evenly; blocks, not pixels, set the uncertainty
FOLDS, ROUNDS = 8, 8  # of the blocks that are held out together; of reweighting
MIN_SLOPE = 0.2  # sine of the elevation of the ball: flatter, boards show their gloss and print is blurred
DISPLACED = 3.0  # variance of a pixel for its texture's: displaced or blurred by 0.7 px (a pixel's own spread is 0.4)
CLIMB = 3.0  # standard errors of the held-out gain of blocks that buy a term
DISAGREE = 3.0  # standard uncertainties between given and measured
TINTS = np.linspace(0.7, 1.05, 15)  # of the third rung


@dataclass(frozen=True)
class Surface:
    """Reflectance head on ``facing`` (3,), ACEScg, with relative ``sigma`` (3,); ``tint`` (3,) None: at all angles.

    Behind ``glass`` its Fresnel reflection, not a metal's, makes the angle dependence.
    """

    facing: np.ndarray
    sigma: np.ndarray
    tint: np.ndarray | None = None
    source: str = "given"
    glass: Glass | None = None

    def at(self, sine: np.ndarray) -> np.ndarray:
        """Reflectance (..., 3) under incidences of this ``sine`` (...); NaN counts as 0."""
        cosine = np.sqrt(np.clip(1 - np.nan_to_num(np.asarray(sine, float)) ** 2, 0, 1))
        return _at(self.facing, self.tint if self.glass is None else self.glass, cosine)


@dataclass(frozen=True)
class Measured:
    """Reflectance head on (3,) with its standard uncertainty (3,), absolute; ``tint`` None: at all angles.

    ``tests``: a row per term that was tried: held-out gain in deviance, its standard error, whether it was taken.
    ``residual``: log of mirrored over modelled, (M, 3), of all pairs; ``scale`` (M, 3) what was expected of it.
    """

    facing: np.ndarray
    sigma: np.ndarray
    tint: float | None
    pairs: int
    blocks: int
    scatter: np.ndarray
    tests: list[dict[str, Any]] = field(default_factory=list)
    residual: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    scale: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


def _at(facing: np.ndarray, tint: np.ndarray | float | Glass | None, cosine: np.ndarray) -> np.ndarray:
    """Reflectance (..., 3) at a cosine (...)."""
    if isinstance(tint, Glass):
        return tint.total(facing, np.sqrt(np.clip(1 - cosine**2, 0, 1)))
    if tint is None:
        return np.broadcast_to(facing, (*np.shape(cosine), 3)).astype(float)
    edge = (facing + (1 - facing) * (1 - GRAZING) ** 5) * tint
    return reflectance_at(facing, edge, cosine)


def measure(views: list[Pairs], tint: np.ndarray | Glass | None = None) -> Measured | None:
    """Reflectance from the pairs of all views; None when too little of the plane is seen both ways.

    ``tint`` (3,) of a known metal, or glass, replaces the ladder. Standard uncertainties are those of blocks (sectors
    about the foot, near and far, of each view), so what neighbouring pixels share is not counted twice. Any surface
    that is seen both ways can be added as pairs of its own: a card, a wall.
    """
    whole = _joined(views)
    block = plane_blocks(views)
    ratio, scale = _log_ratio(whole)
    usable = np.isfinite(scale).all(1) & (whole.slope > MIN_SLOPE)
    usable[np.flatnonzero(usable)[np.arange(usable.sum()) % max(1, -(-usable.sum() // MAX_PAIRS)) > 0]] = False
    counts = np.bincount(block[usable], minlength=block.max(initial=0) + 1)
    usable &= counts[block] >= BLOCK_PAIRS
    if usable.sum() < MIN_PAIRS or (counts >= BLOCK_PAIRS).sum() < MIN_BLOCKS:
        return None
    data = _Data(ratio[usable], scale[usable], _cosine(whole.sine[usable]), whole.tilt[usable], block[usable])
    shape, gloss, tests = _climb(data, tint)
    facing, sigma, scatter = data.fit(shape, gloss)
    residual = ratio - np.log(_at(facing, shape, _cosine(whole.sine)))
    expected = np.hypot(scale, scatter)
    total = facing * np.hypot(sigma, METHOD_SIGMA)
    single = None if shape is None or tint is not None else float(shape)
    return Measured(facing, total, single, int(usable.sum()), data.count, scatter, tests, residual, expected)


def under_gloss(measured: Measured) -> Measured:
    """The measurement where the plane's mirror image is known to differ from the plane by gloss: so much less sure."""
    return replace(measured, sigma=np.hypot(measured.sigma, GLOSS_SIGMA * measured.facing))


def _cosine(sine: np.ndarray) -> np.ndarray:
    return np.sqrt(np.clip(1 - sine**2, 0, 1))


def _joined(views: list[Pairs]) -> Pairs:
    return Pairs(*(np.concatenate([getattr(v, name) for v in views]) for name in Pairs.__dataclass_fields__))


def plane_blocks(views: list[Pairs]) -> np.ndarray:
    """Number (M,) of the block of each pair: sector about the foot, near or far, view."""
    found = []
    for number, pairs in enumerate(views):
        sector = np.floor((pairs.azimuth / (2 * np.pi) % 1) * SECTORS).astype(int)
        far = pairs.slope < (np.median(pairs.slope) if len(pairs) else 0)
        found.append((number * 2 + far) * SECTORS + sector)
    return np.concatenate(found).astype(int)


def _log_ratio(pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of mirrored over direct (M, 3), and its expected standard deviation; inf where it is not known."""
    positive = (pairs.mirrored > 0) & (pairs.direct > 0)
    mirrored, direct = np.where(positive, pairs.mirrored, 1), np.where(positive, pairs.direct, 1)
    variance = pairs.mirrored_variance / mirrored**2 + (pairs.direct_variance + DISPLACED * pairs.texture) / direct**2
    known = positive & np.isfinite(variance) & (variance < 0.3**2)
    return np.log(mirrored / direct), np.where(known, np.sqrt(np.where(known, variance, 0)), np.inf)


@dataclass(frozen=True)
class _Data:
    """Log ratios (M, 3) with expected deviations, cosines of incidence, tilt of the two views of a point, blocks."""

    ratio: np.ndarray
    scale: np.ndarray
    cosine: np.ndarray
    tilt: np.ndarray
    block: np.ndarray

    @property
    def count(self) -> int:
        return len(np.unique(self.block))

    def at(self, keep: np.ndarray) -> _Data:
        return _Data(self.ratio[keep], self.scale[keep], self.cosine[keep], self.tilt[keep], self.block[keep])

    def columns(self, gloss: bool) -> np.ndarray:
        return np.stack([np.ones(len(self.tilt)), self.tilt], -1) if gloss else np.ones((len(self.tilt), 1))

    def fit(self, tint: Any, gloss: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Reflectance head on (3,), its relative standard uncertainty from blocks, and the scatter (3,)."""
        coefficients, sigma, scatter = self.solve(tint, gloss)
        return np.exp(coefficients[0]), sigma, scatter

    def solve(self, tint: Any, gloss: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        facing, columns = np.exp(np.median(self.ratio, 0)), self.columns(gloss)
        for _ in range(3 if tint is not None else 1):
            target = self.ratio - np.log(_at(facing, tint, self.cosine) / facing)
            found = [_robust(columns, target[:, c], self.scale[:, c], self.block) for c in range(3)]
            facing = np.clip(np.exp([coefficient[0] for coefficient, _, _ in found]), 1e-3, 1.2)
        coefficients = np.stack([coefficient for coefficient, _, _ in found], -1)
        return coefficients, np.array([s for _, s, _ in found]), np.array([s for _, _, s in found])

    def deviance(self, tint: Any, gloss: bool, scatter: np.ndarray) -> np.ndarray:
        """Mean Cauchy deviance (B,) of the pixels of each block, fitted on blocks of other folds."""
        _, number = np.unique(self.block, return_inverse=True)
        found = np.empty(len(number))
        for fold in range(FOLDS):
            held = number % FOLDS == fold
            coefficients, _, _ = self.at(~held).solve(tint, gloss)
            found[held] = self.at(held).misfit(coefficients, tint, gloss, scatter)
        return np.asarray(np.bincount(number, found) / np.bincount(number))

    def misfit(self, coefficients: np.ndarray, tint: Any, gloss: bool, scatter: np.ndarray) -> np.ndarray:
        """Cauchy deviance (M,) of each pixel, summed over the channels."""
        model = self.columns(gloss) @ coefficients + np.log(_shape(np.exp(coefficients[0]), tint, self.cosine))
        return np.asarray(2 * np.log1p(((self.ratio - model) / np.hypot(self.scale, scatter)) ** 2).sum(1))


def _shape(facing: np.ndarray, tint: Any, cosine: np.ndarray) -> np.ndarray:
    return np.asarray(_at(facing, tint, cosine) / facing)


def _robust(
    columns: np.ndarray, target: np.ndarray, scale: np.ndarray, block: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Cauchy fit: coefficients, standard uncertainty of the first from blocks (sandwich), scatter beyond ``scale``."""
    scatter, coefficients = 0.02, np.zeros(columns.shape[1])
    coefficients[0] = np.median(target)
    for _ in range(ROUNDS):
        residual = target - columns @ coefficients
        total = np.hypot(scale, scatter)
        weight = 1 / total**2 / (1 + (residual / (2 * total)) ** 2)
        normal = columns.T @ (weight[:, None] * columns)
        coefficients = np.linalg.solve(normal, columns.T @ (weight * target))
        # scatter: what the median absolute residual shows beyond noise and texture
        residual = target - columns @ coefficients
        excess = (1.4826 * np.median(np.abs(residual) / total)) ** 2
        scatter = float(np.clip(scatter * np.sqrt(excess), 1e-3, 0.5))
    _, number = np.unique(block, return_inverse=True)
    scores = np.stack([np.bincount(number, weight * residual * column) for column in columns.T], -1)
    count = len(scores)
    inverse = np.linalg.inv(normal)
    covariance = inverse @ (scores.T @ scores) @ inverse * count / (count - columns.shape[1])
    return coefficients, float(np.sqrt(covariance[0, 0])), scatter


def _climb(data: _Data, tint: np.ndarray | Glass | None) -> tuple[Any, bool, list[dict[str, Any]]]:
    """Tint (None, 1, one number, or the metal's), whether gloss is a term, and a row per trial."""
    _, _, scatter = data.fit(tint, False)
    tests: list[dict[str, Any]] = []
    best = data.deviance(tint, False, scatter)

    def better(name: str, trial: np.ndarray) -> bool:
        gain = best - trial
        error = float(gain.std(ddof=1) / np.sqrt(len(gain)))
        taken = float(gain.mean()) > CLIMB * error
        row = {"term": name, "held_out_gain": float(gain.mean()), "standard_error": error, "taken": bool(taken)}
        tests.append(row)
        return bool(taken)

    gloss = better("gloss of the plane", trial := data.deviance(tint, True, scatter))
    best = trial if gloss else best
    if tint is not None:
        return tint, gloss, tests
    shape: Any = None
    if better("Schlick's angle dependence", trial := data.deviance(1.0, gloss, scatter)):
        best, shape = trial, 1.0
    misfits = [data.misfit(data.solve(t, gloss)[0], t, gloss, scatter).sum() for t in TINTS]
    free = float(TINTS[int(np.argmin(misfits))])
    if better("edge tint", trial := data.deviance(free, gloss, scatter)):
        shape = free
    return shape, gloss, tests


def decide(given: np.ndarray | None, material: str | None, measured: Measured | None) -> tuple[Surface, list[str]]:
    """The surface that is used, and what to warn of. ``given`` (3,) ACEScg, head on; ``material`` of `conductors`.

    Given numbers and measured ones that agree within ``DISAGREE`` sigma are averaged by their weights; where they do
    not, the given ones stay, warned about, and as unsure as the two differ. A metal's own numbers count as given.
    Without any, the measured ones are taken; without those, chrome's, which nobody should rely on.
    """
    tint = None
    source = "given"
    if material is not None:
        base, tint = preset(material)
        if given is None:
            given, source = base, material
    if given is None and measured is None:
        base, tint = preset("chromium")
        text = (
            f"reflectance of the ball: neither given nor measurable; taken as chrome's, {_text(base)} +- 10 %; give "
            "probe.reflectance or probe.material, or let the ball mirror some of the paper"
        )
        return Surface(base, np.full(3, ASSUMED_SIGMA), tint, "assumed chromium"), [text]
    if given is None and measured is not None:
        shape = None if measured.tint is None else np.full(3, measured.tint)
        return Surface(measured.facing, measured.sigma / measured.facing, shape, "measured"), []
    assert given is not None
    if tint is None and measured is not None and measured.tint is not None:
        tint = np.full(3, measured.tint)
    if measured is None:
        return Surface(given, np.full(3, GIVEN_SIGMA), tint, source), []
    difference = np.abs(given - measured.facing)
    sigma = np.hypot(measured.sigma, GIVEN_SIGMA * given)
    if (difference < DISAGREE * sigma).all():
        weights = (GIVEN_SIGMA * given) ** -2.0, measured.sigma**-2.0
        mean = (weights[0] * given + weights[1] * measured.facing) / (weights[0] + weights[1])
        return Surface(mean, 1 / (mean * np.sqrt(weights[0] + weights[1])), tint, f"{source} and measured"), []
    text = (
        f"reflectance of the ball: {source} {_text(given)}, measured {_text(measured.facing)} +- "
        f"{_text(measured.sigma)} from the plane seen in it; {source} kept, as unsure as they differ; leave "
        "probe.reflectance out to use the measured"
    )
    return Surface(given, np.maximum(difference / given, GIVEN_SIGMA), tint, source), [text]


def _text(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in values) + ")"
