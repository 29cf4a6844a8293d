"""What capture.toml states of a sensor, put into a frame, and what is still missing after that."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.image.libraw import XTRANS_MARK
from pipeline.run.errors import CaptureError
from pipeline.types import Frame


def restated(frame: Frame, stated: dict[str, Any]) -> Frame:
    """The frame with the facts of [[sensor]] (the fields of SensorFacts that are given) in place of the file's.

    A stated colour matrix takes the place of all the file's: its second one and its ForwardMatrices belong to others.
    ``bad_pixels`` (N, 2) adds to those that the file marks. Raises CaptureError when a fact does not fit the frame.
    """
    changes: dict[str, Any] = {key: stated[key] for key in ("white", "linear_limit") if key in stated}
    if {"encoding", "space"} & stated.keys():
        if frame.cfa:
            raise CaptureError(f"{frame.file}: a mosaic, and [[sensor]] states encoding or space; take them out")
        changes |= {key: stated[key] for key in ("encoding", "space") if key in stated}
    if "color_matrix" in stated:
        matrix = np.array(stated["color_matrix"], float)
        if abs(np.linalg.det(matrix)) < 1e-6:
            raise CaptureError(f"{frame.file}: the stated color_matrix has no inverse; give the camera's own")
        changes |= {"color_matrix": matrix, "illuminant": int(stated.get("illuminant", 0))}
        changes |= dict.fromkeys(("color_matrix_2", "forward_matrix", "forward_matrix_2")) | {"illuminant_2": 0}
    if "as_shot_neutral" in stated:
        changes["as_shot_neutral"] = np.array(stated["as_shot_neutral"], float)
    if "black" in stated:
        changes["black"] = _black(frame, np.ravel(np.asarray(stated["black"], float)))
    if "bad_pixels" in stated:
        listed = np.asarray(stated["bad_pixels"], int).reshape(-1, 2)
        outside = np.any((listed < 0) | (listed >= (frame.height, frame.width)), axis=1)
        if outside.any():
            row, column = listed[outside][0]
            raise CaptureError(
                f"{frame.file}: bad pixel at row {row}, column {column}; the picture has {frame.height} rows, "
                f"{frame.width} columns; give the list of this camera"
            )
        known = np.zeros((0, 2), int) if frame.bad_pixels is None else frame.bad_pixels
        changes["bad_pixels"] = np.unique(np.concatenate([known, listed]), axis=0)
    return frame.model_copy(update=changes) if changes else frame


def _black(frame: Frame, levels: np.ndarray) -> np.ndarray:
    """(2, 2) or (1, 3) DN of one, three or four stated numbers."""
    if not frame.cfa:
        if levels.size == 4:
            raise CaptureError(f"{frame.file}: black is stated for a CFA cell, the file has R, G, B; give one or three")
        return np.broadcast_to(levels, (1, 3)).copy()
    if levels.size == 3:
        return np.array([levels["RGB".index(letter)] for letter in frame.cfa]).reshape(2, 2)
    return np.broadcast_to(levels, 4).reshape(2, 2).copy()


def missing(frame: Frame, matrix: bool = True) -> list[str]:
    """What a frame still lacks, one line each: where, what was found, what to state. Exposure is not looked at.

    ``matrix``: whether the colour matrix must be the file's or stated; a chart or published sensitivities may give it.
    """
    lines = []
    if frame.white <= float(np.max(frame.black)):
        said = f"white level {frame.white:g}" if frame.white else "no white level"
        lines.append(
            f"{frame.file}: {said} above black {np.max(frame.black):g}, needed where the sensor clips; state white "
            "(and black) in [[sensor]]"
        )
    if XTRANS_MARK in frame.marks and not np.any(frame.black):  # LibRaw keeps black of some of them elsewhere
        lines.append(f"{frame.file}: black is 0, which no X-Trans sensor has; state black in [[sensor]]")
    if matrix and frame.encoding == "linear" and not frame.space and _no_matrix(frame):
        lines.append(
            f"{frame.file}: no colour matrix in the file, needed camera_rgb from XYZ; state color_matrix in [[sensor]]"
            ', convert the file to DNG, or photograph a chart: [chart] fit = "matrix"'
        )
    return lines


def _no_matrix(frame: Frame) -> bool:
    return frame.color_matrix is None or abs(float(np.linalg.det(frame.color_matrix))) < 1e-6


def read_bad_pixels(path: Path) -> np.ndarray:
    """Rows and columns (N, 2) of a list of defects: lines ``row column``, or dcraw's ``column row time``; # comments.

    Raises CaptureError, one line, when it cannot be read so.
    """
    try:
        data = path.read_bytes()
        text = (gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data).decode("ascii")
        lines = [line.split("#")[0].split() for line in text.splitlines()]
        rows = [[int(word) for word in line] for line in lines if line]
    except (OSError, EOFError, ValueError) as error:
        raise CaptureError(f"{path}: no list of bad pixels ({error}); needed lines of row and column") from error
    widths = {len(row) for row in rows}
    if widths not in ({2}, {3}):
        raise CaptureError(f"{path}: lines of {sorted(widths)} numbers; needed row column, or column row time")
    table = np.array(rows)
    listed = table if widths == {2} else table[:, 1::-1]
    if listed.min() < 0:
        raise CaptureError(f"{path}: a negative row or column; needed counts from 0")
    return np.unique(listed, axis=0)
