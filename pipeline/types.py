"""What passes between stages: frozen records whose fields state shape, unit, space and frame.

Small records are pydantic models (validated, written as JSON, arrays as lists); pictures are `Raster`s (EXR files).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer

Array = Annotated[
    np.ndarray,
    BeforeValidator(lambda value: np.asarray(value, float)),
    PlainSerializer(lambda value: value.tolist(), return_type=list),
]
Indices = Annotated[
    np.ndarray,
    BeforeValidator(lambda value: np.asarray(value, int)),
    PlainSerializer(lambda value: value.tolist(), return_type=list),
]


class Record(BaseModel):
    """A small immutable record that is written as JSON."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True, ser_json_inf_nan="constants")


@dataclass(frozen=True, eq=False)
class Raster:
    """A picture on disk: named float32 or uint32 channels of one size, and its header.

    ``channels``: name -> (H, W). Names follow OpenEXR: ``R G B``, ``variance.R`` ..., ``mask`` (uint32), ``Y``.
    An array of float16 is stored as such, and read back as float32.
    ``space``: ``acescg``, ``camera_rgb`` or ``data``. ``attributes``: str, int, float or matrices for the EXR header.
    """

    channels: dict[str, np.ndarray]
    space: str
    attributes: dict[str, Any] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return next(iter(self.channels.values())).shape

    def rgb(self, layer: str = "") -> np.ndarray:
        """(H, W, 3) float32 of the layer: ``""`` reads R G B, ``"variance"`` reads variance.R and so on."""
        prefix = f"{layer}." if layer else ""
        return np.stack([self.channels[prefix + c] for c in "RGB"], -1)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.channels[name]

    @staticmethod
    def split(rgb: np.ndarray, layer: str = "") -> dict[str, np.ndarray]:
        """The three named channels of an (H, W, 3) array, for building ``channels``."""
        prefix = f"{layer}." if layer else ""
        return {prefix + c: rgb[..., i] for i, c in enumerate("RGB")}


class Frame(Record):
    """One photograph of a bracket: what its metadata and its manifest say. Nothing here is estimated.

    A mosaic is (H, W) with a 2x2 ``cfa``; data without one (linear DNG, X-Trans through a demosaic, TIFF, EXR, JPEG)
    are (H, W, 3) with ``cfa`` empty, and everything that is per CFA cell, (2, 2), is then per channel, (1, 3).
    """

    file: str  # relative to the capture's root
    sha256: str
    exposure_s: float  # label
    iso: float
    fnumber: float
    width: int
    height: int
    cfa: str  # colours of the 2x2 cell read in rows, "RGGB"; "" for data that are already (H, W, 3)
    black: Array  # (2, 2) in CFA cell order, (1, 3) of data without one; DN
    white: float  # DN; 0: nobody says
    linear_limit: float = 1.0  # share of white - black up to which the sensor is linear, as DNG LinearResponseLimit
    bad_pixels: Indices | None = None  # (N, 2) row, column of photosites that file or manifest name as defective
    camera: str = ""
    timestamp: str = ""
    color_matrix: Array | None = None  # (3, 3) ColorMatrix1, camera_rgb from XYZ
    color_matrix_2: Array | None = None
    illuminant: int = 0  # EXIF LightSource code of ColorMatrix1
    illuminant_2: int = 0
    as_shot_neutral: Array | None = None  # (3,)
    forward_matrix: Array | None = None  # (3, 3) ForwardMatrix1, XYZ D50 from white balanced camera_rgb
    forward_matrix_2: Array | None = None
    noise_profile: Array | None = None  # (2,) or (6,): DNG NoiseProfile S, O of signal normalised to [0, 1]
    focal_mm: float = 0.0
    focal_35mm: float = 0.0
    lens: str = ""
    vignetting: Array | None = None  # (7,) of DNG's FixVignetteRadial: k0..k4 of its gain, centre x, y in [0, 1]
    encoding: Literal["linear", "display"] = "linear"  # display: through a response curve nobody states (JPEG, HEIC)
    space: str = ""  # linear space of data that are no camera_rgb: "linear_rec709", "acescg"; empty: camera_rgb
    nd_stops: float = 0.0  # of a neutral filter before the lens, as stated; exposure_s and fnumber do not hold it
    marks: list[str] = []  # what is odd about the file and does not forbid its use, one phrase each


class Bracket(Record):
    """The frames of one view, sorted from the shortest to the longest exposure."""

    name: str
    role: str  # "plate", "ball" or "fisheye"
    frames: list[Frame]


class Camera(Record):
    """A pinhole and its lens. ``K`` and the pixel origin as in conventions: first pixel centre at (0.5, 0.5)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Array = np.zeros(5)  # (5,) Brown, (8,) rational or (4,) fisheye: see pipeline/camera/distortion.py
    covariance: Array = np.zeros((9, 9))  # of fx, fy, cx, cy (px) and the coefficients of distortion (1)
    rms_px: float = 0.0
    source: str = "given"
    body: str = ""  # with lens and focal_mm: what metadata say of the optics that this is the camera of; "", 0: unknown
    lens: str = ""
    focal_mm: float = 0.0

    @property
    def K(self) -> np.ndarray:
        """(3, 3) intrinsic matrix, pixel origin of conventions."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])


class Motion(Record):
    """How the camera moved on its tripod between the view that shows the board and the plate, by what both show.

    The turn is undone in the pose; the ``rest``, where still things lie off it, is not: parallax of a tripod that was
    pushed aside, or a lens that was touched.
    """

    of: str  # the view that shows the board
    rotation: Array  # (3,) rad, p_of = exp(rotation) p_plate in camera frames
    covariance: Array  # (3, 3) of it
    rest: Array  # (3, 2) px: (1, x / width - 1/2, y / height - 1/2) @ rest is what is left at a pixel x, y
    rest_covariance: Array  # (3, 3) of each column of it


class View(Record):
    """Where one photograph was taken from."""

    world_from_camera: Array  # (4, 4), metres
    covariance: Array  # (6, 6), see conventions
    route: str  # charuco, marker, points, given, colmap, same_as, tripod
    rms_px: float
    points: int  # image points used
    ambiguity: float = np.inf  # squared residual of the second planar solution over the first
    alternative: Array | None = None  # (4, 4) the second planar solution, refined
    lens_covariance: Array | None = None  # (6, L) of the pose with the camera's L numbers; None when given
    camera: Camera | None = None  # its own body, lens or size; None: the plate's
    motion: Motion | None = None  # what was undone; of a plate that was registered to a tripod view
    # Standard deviation [px] of the Gaussian that lens and pixel box make together (the box counts as variance 1/12),
    # measured on the edges of the print that the view shows, demosaicking taken off; None: too few of them show.
    softness_px: float | None = None
    softness_sigma_px: float = 0.0  # standard uncertainty at one place of the print, what varies over it included


class Sources(Record):
    """What the further views are needed for: decided before they are oriented, by what is cheaper."""

    cloud: bool = False  # whether they are to be oriented at all
    views: list[str] = []  # whose pose is to come from them: no cheaper source is good enough, or it was asked for
    lens: Camera | None = None  # EXIF's, made surer by boards in the capture's own views; None: nothing to add


class Reconstruction(Record):
    """Poses, lenses and a cloud of points from photographs alone (structure from motion), in a frame of its own.

    Empty when nothing asked for it. The frame has no unit and no up.
    """

    method: str = ""  # "incremental" or "global"
    names: list[str] = []  # photographs that were oriented: views by name, others by file
    missing: list[str] = []  # those that were not
    world_from_camera: Array = np.zeros((0, 4, 4))  # (N, 4, 4)
    cameras: list[Camera] = []
    camera_of: Indices = np.zeros(0, int)  # (N,)
    points: Array = np.zeros((0, 3))  # (M, 3)
    seen_view: Indices = np.zeros(0, int)  # (K,) which photograph
    seen_point: Indices = np.zeros(0, int)  # (K,) shows which point
    px: Array = np.zeros((0, 2))  # (K, 2) where
    orients: list[str] = []  # views whose pose is to come from it, by `Sources`


class BallFit(Record):
    """The sphere seen in one view, in that view's camera frame."""

    centre_camera_m: Array  # (3,)
    radius_m: float
    covariance: Array  # (3, 3) of the centre, m^2
    rms_px: float
    points: int
    radius_px: float
    reflectance: Array = np.ones(3)  # (3,) head on, ACEScg
    edge_tint: Array | None = None  # (3,) of its angle dependence; None: the same at all angles
    glass: float = 0.0  # thickness of the glass before the mirror, of the radius; 0: none


class Plane(Record):
    """The local scene's plane ``normal . p = offset_m`` in the world frame, and the rectangle that is modelled."""

    normal: Array  # (3,) unit, outward
    offset_m: float
    covariance: Array  # (3, 3) of (tilt about x [rad], tilt about z [rad], offset [m])
    corners_m: Array  # (4, 3) counter-clockwise seen from outside
    source: str
    contact_sigma_px: float = 0.0


class Surface(Record):
    """How the plane reflects besides its albedo, with the held-out scores that decided (see stages/reflectance.py)."""

    model: Literal["diffuse", "rough", "metallic"] = "diffuse"
    roughness: float = 1.0  # glTF: alpha = roughness^2
    f0: float = 0.04  # reflectance of the dielectric lobe at normal incidence
    metallic: float = 0.0
    scores: list[dict[str, Any]] = []  # one row per rung of the ladder


class Proxy(Record):
    """A further real surface of the local scene: it receives shadows and light, casts them, and stays the plate's."""

    name: str
    vertices_m: Array  # (N, 3), world frame
    faces: Indices  # (M, 3), counter-clockwise seen from outside
    albedo: Array | None = None  # (3,), ACEScg; None: to be measured from the plate


class Occluder(Record):
    """A real thing in front of the inserted objects: a mesh, or a mask picture of the plate's size. One of them."""

    name: str
    vertices_m: Array | None = None  # (N, 3), world frame
    faces: Indices | None = None  # (M, 3)
    mask_file: str | None = None  # absolute path of a PNG or EXR; 1 in front, 0 not; `formats.read_mask` reads it
    mask_sha256: str = ""


class Harmonics(Record):
    """Nine real spherical harmonics of the environment's *radiance*, and what turns them into irradiance."""

    quantity: Literal["radiance"] = "radiance"
    basis: str = "real, orthonormal on the sphere: 1, y, z, x, xy, yz, 3zz-1, xz, xx-yy of the unit direction"
    sign: str = "no Condon-Shortley phase: the coefficient of y is positive when light comes from +y"
    frame: Literal["world"] = "world"
    coefficients: Array  # (9, 3), ACEScg, radiance unit times steradian
    sigma: Array  # (9, 3), standard uncertainty, texels taken as independent
    irradiance_factors: Array  # (9,): irradiance at normal n is sum_i factor_i coefficient_i basis_i(n)


class Emitter(Record):
    """A compact light: an exact set of texels of the lighting. What no emitter holds is the sky."""

    name: str  # "sun", "lamp_1", ... by falling irradiance
    direction: Array  # (3,), unit, world frame: towards the light, mean weighted by irradiance or as its shadow says
    direction_sigma_rad: Array = np.zeros(2)  # (2,) level and upright, of a lamp that its shadow's edge places; else 0
    solid_angle_sr: float  # of its texels
    half_angle_rad: float  # of the uniform disc of the same spread
    half_angle_sigma_rad: float = 0.0  # how much wider it may be, one standard uncertainty
    irradiance: Array  # (3,), ACEScg, of its texels alone on a surface that faces ``direction``
    texels: Indices  # (N,), flat indices (row * width + column) into the lighting, ascending
    irradiance_sigma: Array = np.zeros(3)  # (3,) of ``irradiance``
    lower_bound: bool = False  # clipped in every frame, and nothing tells how bright it really is
    evidence: str = "measured"  # or "recovered", or "clipped": where its brightness comes from


class Balance(Record):
    """What brings a view to the plate's exposure and colour: gains on its ACEScg channels."""

    gains: Array  # (3,), multiply the view's photograph by them
    covariance: Array  # (3, 3) of the logarithms of the gains
    references: list[str]  # names of those that gave them; empty: assumed
    applied: bool  # whether they differ from 1 beyond their uncertainty; else the photograph is used as it is


@dataclass(frozen=True)
class Result:
    """What a stage's compute returns: outputs by name, measured numbers, warnings, and evidence for model choices."""

    outputs: dict[str, Any]
    numbers: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    evidence: list[dict[str, Any]] = field(default_factory=list)  # rows of pipeline.run.evidence
