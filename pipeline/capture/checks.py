"""What is missing from a capture, one small judgement each: severity, what was found, and the photograph to take.

A judgement knows numbers only (`pipeline.capture.measures`), so each is tested by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np

from pipeline.capture.measures import MOST_STOPS, SNR, Drift, Lamps
from pipeline.types import Frame, Record

RADIUS_ASKED_PX, RADIUS_NEEDED_PX = 100.0, 40.0
BLUR_ADVICE_PX, BLUR_NEEDED_PX = 2.5, 5.0  # sigma of the rim; `pipeline.probes.finding.SOFT_PX`
LEAST_VISIBLE = 0.7  # of the outline; `pipeline.probes.finding.MIN_VISIBLE`
FASTEST_S, LONGEST_S = 1 / 8000, 30.0  # shutters that most cameras have
LAMP_NITS, SUN_NITS = 3e5, 1.6e9  # no bulb's surface is brighter than the first
TILT_ASKED_DEG, TILTS_NEEDED_DEG = 15.0, 30.0
MARKERS_ASKED, MARKERS_NEEDED, MARKER_SIDE_PX = 8, 4, 20.0
PHOTOS_ASKED, PHOTOS_NEEDED, SPAN_ASKED = 10, 4, 0.6
GAP_EV, WIDE_GAP_EV = 3.0, 5.0
SHIFT_ADVICE_PX, SHIFT_NEEDED_PX = 0.3, 1.0
LIGHT_SAME_SETTING, LIGHT_BY_LABELS = 0.02, 0.1  # relative; labels are wrong by up to 7 %
SHARPNESS = 0.6  # ratio of fine detail between two views of one place


class Finding(Record):
    """One judgement. ``take``: the photograph to take before leaving; empty when nothing is to be done."""

    check: str
    severity: Literal["ok", "advice", "problem"]
    where: str
    text: str
    take: str = ""

    def line(self) -> str:
        """The judgement as one line."""
        return f"{self.severity:<8} {self.where}: {self.text}" + (f"; take: {self.take}" if self.take else "")


def shutter(seconds: float) -> str:
    """A shutter time as cameras write it."""
    return f"{seconds:.3g} s" if seconds >= 0.3 else f"1/{1 / seconds:.0f} s"


def clipped_lights(where: str, lamps: Lamps, frame: Frame, ball: bool) -> Finding:
    """Whether the shortest frame still clips, and what would not: a shorter time, else a neutral filter.

    Saturation luminance L = 120 N^2 / (t ISO) nits is ISO 12232's saturation speed, 78 lux s, over 0.65 of lens loss.
    """
    check = "clipped_lights"
    if lamps.share == 0:
        return Finding(check=check, severity="ok", where=where, text="the shortest frame clips nothing")
    told = lamps.stops < MOST_STOPS
    stops = max(1, int(np.ceil(lamps.stops))) if told else 2
    over = f"is over by about {stops} EV" if told else "has sharp edges, which do not tell by how much it is over"
    text = (
        f"the shortest frame ({shutter(frame.exposure_s) if frame.exposure_s else 'time not stated'}) clips "
        f"{lamps.share:.3%} of {'the ball' if ball else 'the picture'}; a spot {lamps.width_px:.0f} px wide {over}"
    )
    take = f"the same view {stops} EV darker" if not frame.exposure_s else next_shorter(frame, stops)
    take += "" if told else f", and so on by {stops} EV until nothing clips"
    severity: Literal["advice", "problem"] = "problem" if ball else "advice"
    return Finding(check=check, severity=severity, where=where, text=text, take=take)


def next_shorter(frame: Frame, stops: int) -> str:
    """The frame to add that is so many stops shorter: a shutter, or a neutral filter where none is short enough."""
    time = frame.exposure_s / 2**stops
    take = f"one more frame at {shutter(time)}"
    if time < FASTEST_S:
        filters = int(np.ceil(np.log2(FASTEST_S / time)))
        take = f"one more frame at {shutter(FASTEST_S)} with a {filters} EV neutral filter (ND{2**filters})"
    nits = 120 * frame.fnumber**2 / (frame.exposure_s * (frame.iso or 100))
    if nits > LAMP_NITS:
        sun = int(np.ceil(np.log2(SUN_NITS / nits)))
        take += f"; if it is the sun, {max(sun, 1)} EV darker than the shortest"
    return take


def darkest(where: str, snr: float, stops: float, frame: Frame) -> Finding:
    """Whether the darkest part is above the noise in the longest frame."""
    if snr >= SNR or stops < 0.5:
        return Finding(
            check="darkest", severity="ok", where=where, text=f"its darkest part is {snr:.0f} times its noise"
        )
    time = frame.exposure_s * 2 ** np.ceil(stops)
    text = f"its darkest part is {snr:.1f} times its noise in the longest frame, needed {SNR:.0f}"
    take = f"one more frame {np.ceil(stops):.0f} EV longer" + (f", {shutter(time)}" if 0 < time <= LONGEST_S else "")
    return Finding(check="darkest", severity="advice", where=where, text=text, take=take)


def ball_size(where: str, radius_px: float) -> Finding:
    """Whether the ball is large enough: at its middle a pixel is 2 / radius of light direction."""
    degrees = float(np.degrees(2 / radius_px))
    text = f"ball radius {radius_px:.0f} px: a pixel at its middle is {degrees:.1f} degrees of light direction"
    if radius_px >= RADIUS_ASKED_PX:
        return Finding(check="ball_size", severity="ok", where=where, text=text)
    severity: Literal["advice", "problem"] = "problem" if radius_px < RADIUS_NEEDED_PX else "advice"
    closer = RADIUS_ASKED_PX / radius_px
    text += f"; asked {RADIUS_ASKED_PX:.0f} px ({np.degrees(2 / RADIUS_ASKED_PX):.1f} degrees)"
    return Finding(
        check="ball_size", severity=severity, where=where, text=text,
        take=f"this view again from {1 / closer:.0%} of the distance, or with {closer:.1f} times the focal length",
    )  # fmt: skip


def ball_focus(where: str, blur_px: float) -> Finding:
    """Whether the ball's rim is sharp."""
    text = f"the ball's rim is blurred by {blur_px:.1f} px"
    if blur_px < BLUR_ADVICE_PX:
        return Finding(check="ball_focus", severity="ok", where=where, text=text)
    severity: Literal["advice", "problem"] = "problem" if blur_px >= BLUR_NEEDED_PX else "advice"
    take = "this view again, focused on the ball's rim, the aperture closed by a stop"
    return Finding(
        check="ball_focus", severity=severity, where=where, text=f"{text}, needed {BLUR_ADVICE_PX} px", take=take
    )


def ball_framed(where: str, visible: float) -> Finding:
    """Whether the frame cuts the ball."""
    if visible > 0.995:
        return Finding(check="ball_framed", severity="ok", where=where, text="the whole ball is in the frame")
    severity: Literal["advice", "problem"] = "problem" if visible < LEAST_VISIBLE else "advice"
    text = f"{visible:.0%} of the ball's outline is in the frame"
    return Finding(
        check="ball_framed", severity=severity, where=where, text=text, take="this view again, ball in frame"
    )


def ball_found(where: str, found: bool) -> Finding:
    """Whether the ball was found at all."""
    if found:
        return Finding(check="ball_found", severity="ok", where=where, text="the ball is found")
    text = "no mirror ball is found at half size"
    return Finding(check="ball_found", severity="problem", where=where, text=text, take="this view again, nearer to it")


def second_ball(where: str, views: int, others: int) -> Finding:
    """Whether the ball was seen from two sides; ``others``: views that are not the plate's."""
    if views >= 2 and others:
        return Finding(check="second_ball", severity="ok", where=where, text=f"{views} views of the ball")
    text = "one view of the ball" if views < 2 else "all views of the ball are the plate's own"
    text += ": what lies behind it is not seen, the photographer stays in the light"
    take = "a bracket of the ball from about 90 degrees around, the board in the frame"
    return Finding(check="second_ball", severity="advice", where=where, text=text, take=take)


def board_seen(where: str, markers: int, side_px: float) -> Finding:
    """Whether a view that needs the board for its pose shows enough of it."""
    if markers >= MARKERS_ASKED and side_px >= MARKER_SIDE_PX:
        return Finding(check="board_seen", severity="ok", where=where, text=f"{markers} markers, {side_px:.0f} px wide")
    severity: Literal["advice", "problem"] = "problem" if markers < MARKERS_NEEDED else "advice"
    text = f"{markers} markers" + (f", {side_px:.0f} px wide" if markers else "")
    text += f"; asked {MARKERS_ASKED} of {MARKER_SIDE_PX:.0f} px"
    take = "this view again with the whole board in the frame, nearer to it, nothing on it"
    return Finding(check="board_seen", severity=severity, where=where, text=text, take=take)


def board_tilted(where: str, tilt_deg: float, single: bool) -> Finding:
    """Whether the board is seen obliquely enough to have one pose; a single marker needs it more."""
    text = f"the board is tilted by {tilt_deg:.0f} degrees"
    if tilt_deg >= (TILT_ASKED_DEG + 5 if single else TILT_ASKED_DEG):
        return Finding(check="board_tilted", severity="ok", where=where, text=text)
    severity: Literal["advice", "problem"] = "problem" if single else "advice"
    text += ": seen squarely, two poses fit nearly alike"
    take = "this view from lower down, the board tilted by 20 degrees or more"
    return Finding(check="board_tilted", severity=severity, where=where, text=text, take=take)


def calibration(where: str, photos: int, tilts_deg: Sequence[float], span: tuple[float, float]) -> list[Finding]:
    """Whether the board photographs determine a lens: how many, how tilted, and how far into the corners."""
    many = PHOTOS_ASKED - photos
    if photos < PHOTOS_NEEDED:
        text = f"{photos} photographs of the board, needed {PHOTOS_NEEDED}, asked {PHOTOS_ASKED}"
        take = f"{many} of the board filling the frame, tilted 30 to 45 degrees to all sides, into the corners"
        return [Finding(check="calibration_count", severity="problem", where=where, text=text, take=take)]
    found = []
    if many > 0:
        text, take = (
            f"{photos} photographs of the board, asked {PHOTOS_ASKED}",
            f"{many} more of the board, other tilts",
        )
        found.append(Finding(check="calibration_count", severity="advice", where=where, text=text, take=take))
    if max(tilts_deg, default=0.0) < TILTS_NEEDED_DEG:
        text = (
            f"the board is tilted by at most {max(tilts_deg, default=0.0):.0f} degrees, needed {TILTS_NEEDED_DEG:.0f}"
        )
        take = "four of the board tilted 30 to 45 degrees, to four sides: else focal length and distance look alike"
        found.append(Finding(check="calibration_tilt", severity="problem", where=where, text=text, take=take))
    if min(span) < SPAN_ASKED:
        text = f"the board spans {span[0]:.0%} by {span[1]:.0%} of the frame, asked {SPAN_ASKED:.0%}"
        take = "four of the board, one in each corner of the frame"
        found.append(Finding(check="calibration_span", severity="advice", where=where, text=text, take=take))
    text = (
        f"{photos} photographs, tilts to {max(tilts_deg, default=0):.0f} degrees, over {span[0]:.0%} by {span[1]:.0%}"
    )
    return found or [Finding(check="calibration", severity="ok", where=where, text=text)]


def ladder(where: str, frames: Sequence[Frame], exposures: Sequence[float]) -> list[Finding]:
    """Gaps of the exposure ladder, where noise is high between two frames."""
    if min(exposures) <= 0:
        text = "exposure times are not stated in the files"
        take = "nothing: note the times, and state them as [[exposure]]"
        return [Finding(check="ladder", severity="problem", where=where, text=text, take=take)]
    found = []
    for (one, short), (other, long) in pairwise(sorted(zip(exposures, [f.exposure_s for f in frames]))):
        gap = float(np.log2(other / one))
        if gap > GAP_EV + 0.15:
            severity: Literal["advice", "problem"] = "problem" if gap > WIDE_GAP_EV else "advice"
            text = f"{gap:.1f} EV between {shutter(short)} and {shutter(long)}, asked at most {GAP_EV:.0f}"
            take = f"one more frame at {shutter(float(np.sqrt(short * long)))}"
            found.append(Finding(check="ladder", severity=severity, where=where, text=text, take=take))
    return found or [Finding(check="ladder", severity="ok", where=where, text=f"{len(frames)} frames without a gap")]


def bracketed(where: str, frames: int) -> Finding:
    """Whether there is a bracket at all."""
    if frames > 1:
        return Finding(check="bracketed", severity="ok", where=where, text=f"{frames} frames")
    text, take = "a single frame", "a bracket of it: two more frames, 2 EV longer and 2 EV shorter"
    return Finding(check="bracketed", severity="advice", where=where, text=text, take=take)


def settings(where: str, frames: Sequence[Frame]) -> list[Finding]:
    """Settings that must not change within a bracket, and formats that lose light."""
    found = []
    for name, unit in (("iso", "ISO "), ("fnumber", "f/"), ("focal_mm", "focal length [mm] ")):
        values = sorted({round(float(getattr(frame, name)), 3) for frame in frames if getattr(frame, name)})
        if len(values) > 1:
            severity: Literal["advice", "problem"] = "problem" if name == "focal_mm" else "advice"
            text = f"{unit}{', '.join(f'{value:g}' for value in values)} within one bracket"
            take = "the bracket again in manual mode, only the shutter changed"
            found.append(Finding(check=f"mixed_{name}", severity=severity, where=where, text=text, take=take))
    if any(frame.encoding == "display" for frame in frames):
        text = "JPEG or HEIC only: its response must be recovered, clipping comes earlier, eight bits are left"
        take = "the bracket again as RAW"
        found.append(Finding(check="not_raw", severity="advice", where=where, text=text, take=take))
    neutrals = [frame.as_shot_neutral for frame in frames if frame.as_shot_neutral is not None]
    if any(not np.allclose(neutral, neutrals[0], rtol=1e-3) for neutral in neutrals):
        text = "white balance changes within the bracket (automatic); RAW is not harmed, other pictures are"
        take = "further brackets with the white balance fixed"
        found.append(Finding(check="white_balance", severity="advice", where=where, text=text, take=take))
    return found


def same_lens(where: str, plate: Frame, ball: Frame, own_camera: bool, reference: bool) -> list[Finding]:
    """Whether a view by another body, size or focal length says so, and has something grey in common."""
    differs = [
        text
        for text, a, b in (
            ("camera", plate.camera, ball.camera),
            ("size", (plate.width, plate.height), (ball.width, ball.height)),
            ("focal length", round(plate.focal_mm, 1), round(ball.focal_mm, 1)),
        )
        if a and b and a != b
    ]
    found = []
    if differs and not own_camera:
        text = f"another {' and '.join(differs)} than the plate's, and no camera table of its own"
        take = f"this view with the plate's camera and lens, or {PHOTOS_ASKED} photographs of the board by this one"
        found.append(Finding(check="same_lens", severity="problem", where=where, text=text, take=take))
    if "camera" in differs and not reference:
        text = "another camera than the plate's, and nothing grey that both show: 5 % in exposure and colour is open"
        take = "a grey card or 24-patch chart, lit alike, once by each camera"
        found.append(Finding(check="reference", severity="advice", where=where, text=text, take=take))
    return found


def drifted(where: str, drift: Drift) -> list[Finding]:
    """What changed between the plate and a view from its tripod, besides the ball."""
    found = []
    if drift.shift_px > SHIFT_ADVICE_PX:
        severity: Literal["advice", "problem"] = "problem" if drift.shift_px > SHIFT_NEEDED_PX else "advice"
        text = f"the camera moved by {drift.shift_px:.1f} px between plate and this view"
        take = "the plate again, now, without touching the tripod"
        found.append(Finding(check="moved", severity=severity, where=where, text=text, take=take))
    allowed = LIGHT_SAME_SETTING if drift.same_setting else LIGHT_BY_LABELS
    if abs(drift.light_rel) > allowed:
        text = f"the light is {drift.light_rel:+.0%} of the plate's in this view, allowed {allowed:.0%}"
        take = "plate and ball again, quickly one after the other, while the light is steady"
        found.append(Finding(check="light_changed", severity="advice", where=where, text=text, take=take))
    if not SHARPNESS < drift.sharpness < 1 / SHARPNESS:
        text = f"fine detail is {drift.sharpness:.0%} of the plate's in this view: the focus changed"
        take = "plate and ball again with the focus fixed (manual)"
        found.append(Finding(check="focus_changed", severity="advice", where=where, text=text, take=take))
    text = f"moved {drift.shift_px:.2f} px against the plate, light {drift.light_rel:+.1%}"
    return found or [Finding(check="drift", severity="ok", where=where, text=text)]


def unread(flaw: str) -> Finding:
    """A photograph that cannot be read, as its reader says."""
    take = "it again, unless the card still has it whole"
    return Finding(check="unread", severity="problem", where="files", text=flaw, take=take)


def present(counts: Mapping[str, int]) -> list[Finding]:
    """Whether plate and ball are there at all."""
    take = {
        "plate": "a bracket of the place without the ball, the board in the frame",
        "ball": "a bracket of the mirror ball where the objects will stand, from the plate's tripod",
    }
    return [
        Finding(
            check=f"no_{role}", severity="problem", where=role, text=f"no {role} among the photographs", take=take[role]
        )
        for role in ("plate", "ball")
        if not counts.get(role)
    ]


def no_board(where: str, layout: bool, poses_given: bool) -> list[Finding]:
    """Whether anything gives scale and pose."""
    if layout or poses_given:
        return []
    text = "no board or marker is seen in any photograph: nothing gives scale and pose"
    take = "plate and a ball view with the printed board flat on the surface"
    return [Finding(check="no_board", severity="problem", where=where, text=text, take=take)]
