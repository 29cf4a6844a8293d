"""The size of a ball whose diameter was not given: from every view that shows it, averaged."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.probes import mirror_ball
from pipeline.run.errors import CaptureError


def solved(
    monkeypatch: pytest.MonkeyPatch, **views: tuple[float, float, bool] | None
) -> tuple[float, float, list[str]]:
    """Radius, sigma and warnings where each view gives radius, sigma and whether the plane's image does, or nothing."""

    def solve(name, *_):
        if views[name] is None:
            raise CaptureError(f"{name}: no mirror ball of any size")
        return views[name][0], views[name][1], name

    def by_image(name, *_):
        radius, sigma, image = views[name]
        return (radius, sigma) if image else None

    monkeypatch.setattr(mirror_ball, "solve_radius", solve)
    monkeypatch.setattr(mirror_ball, "anchored_radius", by_image)
    facts = {"probe": {}, "ball": [{"name": name} for name in views]}
    shots = SimpleNamespace(
        facts=facts, photographs=dict.fromkeys(views), views=dict.fromkeys(views), camera_of=lambda name: None
    )
    warnings: list[str] = []
    radius, sigma = mirror_ball.radius_of(shots, list(views), set(), warnings)  # type: ignore[arg-type]
    return radius, sigma, warnings


def test_a_view_that_shows_no_size_takes_that_of_the_others(monkeypatch):
    radius, sigma, warnings = solved(monkeypatch, a=None, b=(0.04, 1e-4, True))
    assert (radius, sigma) == pytest.approx((0.04, 1e-4))
    assert "not found at unknown size: a" in warnings[0]


def test_no_view_shows_one(monkeypatch):
    with pytest.raises(CaptureError, match="a: no mirror ball of any size"):
        solved(monkeypatch, a=None, b=None)


def test_views_are_weighed_and_the_rim_alone_is_believed_less(monkeypatch):
    radius, sigma, warnings = solved(monkeypatch, a=(0.0400, 1e-4, True), b=(0.0401, 1e-4, False))
    weight = np.array([1.0, mirror_ball.RIM_SIZE_FACTOR**-2])
    assert radius == pytest.approx(weight @ [0.0400, 0.0401] / weight.sum())
    assert sigma == pytest.approx(1e-4 * weight.sum() ** -0.5)
    assert len(warnings) == 1


def test_sizes_that_contradict_each_other_are_less_sure_and_said(monkeypatch):
    radius, sigma, warnings = solved(monkeypatch, a=(0.040, 1e-4, True), b=(0.042, 1e-4, True))
    assert radius == pytest.approx(0.041)
    assert sigma == pytest.approx(1e-3)  # half their difference, as two values allow
    assert "one ball on one plane" in warnings[1]


def test_a_given_diameter_is_taken_as_it_is():
    shots = SimpleNamespace(facts={"probe": {"diameter_m": 0.08}})
    assert mirror_ball.radius_of(shots, [], set(), []) == (0.04, 0.0)  # type: ignore[arg-type]
