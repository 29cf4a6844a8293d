"""From scene-linear ACEScg to the bytes of a picture, through OpenColorIO.

The config is the one ``$OCIO`` names, else a pinned built-in one (a name without version would change pictures with the
library). Display pictures are leaves: nothing reads them back.
"""

from __future__ import annotations

import os
import re
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numpy as np

from pipeline.image import colour
from pipeline.run.errors import ManifestError

BUILTIN_CONFIG = "ocio://cg-config-v4.0.0_aces-v2.0_ocio-v2.5"
DISPLAY = "sRGB - Display"
VIEW = "ACES 2.0 - SDR 100 nits (Rec.709)"
MID_GREY = 0.18
DIFFUSE_WHITE = 0.9
LOOK_MARKS = re.compile(r"[,:|]|(?:(?<=[,:|\s])|^)\s*[+-]")  # between looks, or for the direction of one
THREADS = 2  # the processor releases the GIL: two row blocks take half the time of one

# AP1 -> AP0, S-2014-004 (ACEScg), appendix A; only for configs that know ACES2065-1 and not ACEScg.
AP0_FROM_AP1 = np.array(
    [
        [0.6954522414, 0.1406786965, 0.1638690622],
        [0.0447945634, 0.8596711185, 0.0955343182],
        [-0.0055258826, 0.0040252103, 1.0015006723],
    ]
)
NOT_FINITE = (255, 0, 255)  # magenta: a NaN must be seen


def config_name() -> str:
    """The OCIO config in force: the value of ``$OCIO`` or the pinned built-in one."""
    return os.environ.get("OCIO") or BUILTIN_CONFIG


def display_views(name: str | None = None) -> dict[str, list[str]]:
    """The displays of the config and the views of each."""
    config = _config(name or config_name())
    return {display: list(config.getViews(display)) for display in config.getDisplays()}


def auto_exposure(rgb: np.ndarray) -> float:
    """Exposure [EV] that puts the median luminance of an ACEScg picture (..., 3) at mid grey.

    Only finite, positive pixels count; 0 when there are none.
    """
    return _exposure(rgb, 0.5, MID_GREY)


def display_exposure(rgb: np.ndarray) -> float:
    """Exposure [EV] of a picture to look at: halfway between the median at mid grey and the bright parts at white.

    The median alone leaves a wooden table with a sheet of paper too dark, the bright parts alone a room with a lamp.
    """
    return 0.5 * (_exposure(rgb, 0.5, MID_GREY) + _exposure(rgb, 0.99, DIFFUSE_WHITE))


def _exposure(rgb: np.ndarray, quantile: float, target: float) -> float:
    luminance = colour.luminance(rgb.reshape(-1, 3))
    luminance = luminance[np.isfinite(luminance) & (luminance > 0)]
    return float(np.log2(target / np.quantile(luminance, quantile))) if luminance.size else 0.0


def display_transform(
    rgb: np.ndarray, display: str = DISPLAY, view: str = VIEW, exposure_ev: float = 0.0, look: str = ""
) -> np.ndarray:
    """Display picture (H, W, 3) uint8 of scene-linear ACEScg (H, W, 3).

    Values outside the display are clipped here and nowhere before; non-finite pixels come out magenta. ``look``, one
    or several in OCIO's own notation (``grade, -print``), stands in for the looks of the view; empty keeps those.
    Raises ManifestError with the valid names when the config has no such display, view or look.
    """
    processor = _processor(config_name(), display, view, look)
    picture = np.array(rgb, np.float32, order="C", copy=True)
    bad = ~np.isfinite(picture).all(-1)
    picture *= np.float32(2.0**exposure_ev)
    picture[bad] = 0
    blocks = [block for block in np.array_split(picture, THREADS) if block.size]
    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(processor.applyRGB, blocks))
    np.clip(picture, 0, 1, out=picture)
    coded = (picture * 255 + 0.5).astype(np.uint8)
    coded[bad] = NOT_FINITE
    return coded


def cdl_collection(slopes: dict[str, np.ndarray], descriptions: dict[str, str], space: str) -> str:
    """An ASC CDL ColorCorrectionCollection (XML): by id, slopes (3,) on linear values of ``space``, with what they do.

    Offset 0, power 1, saturation 1, so that a correction with the inverse slopes undoes it.
    """
    import PyOpenColorIO as ocio

    if not slopes:  # which the library refuses to write
        return '<ColorCorrectionCollection xmlns="urn:ASC:CDL:v1.01"/>\n'
    chain = ocio.GroupTransform()
    for name, slope in slopes.items():
        cdl = ocio.CDLTransform(slope=[float(v) for v in slope], id=name, description=descriptions[name])
        cdl.getFormatMetadata().addChildElement("InputDescription", f"scene-linear {space}")
        chain.appendTransform(cdl)
    return str(chain.write("ColorCorrectionCollection", config=ocio.Config.CreateRaw()))


@lru_cache(maxsize=4)
def _config(name: str) -> Any:
    import PyOpenColorIO as ocio

    try:
        return ocio.Config.CreateFromFile(name)
    except (ocio.Exception, ocio.ExceptionMissingFile) as error:
        raise ManifestError(
            f"OCIO: {name!r} is not a readable config ({error}); set $OCIO right or unset it"
        ) from error


@lru_cache(maxsize=16)
def _processor(name: str, display: str, view: str, look: str) -> Any:
    import PyOpenColorIO as ocio

    config, views = _config(name), display_views(name)
    if display not in views:
        raise ManifestError(f"composite.display: is {display!r}; {name} has {sorted(views)}")
    if view not in views[display]:
        raise ManifestError(f"composite.view: is {view!r}; {display!r} of {name} has {views[display]}")
    looks = [one.strip() for one in LOOK_MARKS.split(look) if one.strip()]
    if unknown := [one for one in looks if config.getLook(one) is None]:
        known = [one.getName() for one in config.getLooks()]
        raise ManifestError(f"composite.look: is {look!r}; {name} has {known or 'no looks'}, not {unknown}")
    chain = ocio.GroupTransform()
    if config.getColorSpace("ACEScg") is not None:
        source = "ACEScg"
    elif config.hasRole("aces_interchange"):
        source = "aces_interchange"
        matrix = np.eye(4)
        matrix[:3, :3] = AP0_FROM_AP1
        chain.appendTransform(ocio.MatrixTransform(matrix=matrix.ravel().tolist()))
    else:
        raise ManifestError(f"OCIO: {name!r} has neither ACEScg nor the role aces_interchange; use another config")
    if looks:
        chain.appendTransform(ocio.LookTransform(src=source, dst=source, looks=look))
    chain.appendTransform(ocio.DisplayViewTransform(src=source, display=display, view=view, looksBypass=bool(looks)))
    return config.getProcessor(chain).getDefaultCPUProcessor()
