"""Shadows told from grey paint: soft ones by having no edge, those of the sun by their one darkness."""

import cv2
import numpy as np
import pytest

from visfuse_cli.vision.background import FOREGROUND, SHADOW
from visfuse_cli.vision.cast_shadows import LIT, Darkness, lightness, without_soft_shadows

H, W = 240, 320
ROAD = 90.0


def picture(light, noise=0.0):
    """Labels and lightness of a road (H, W) that is as light as `light` says."""
    rng = np.random.default_rng(4)
    seen = np.clip(ROAD * light + rng.normal(0, noise, light.shape), 0, 255).astype(np.uint8)
    labels = np.where(light > 0.95, 0, np.where(light < 0.45, FOREGROUND, SHADOW)).astype(np.uint8)
    return labels, lightness(seen, np.full((H, W), round(ROAD), np.uint8))


def around(dark, width):
    """A dark thing in the middle, beside which the road is lighter the further away, over `width` px."""
    light = np.ones((H, W))
    light[80:160, 120:200] = dark
    return np.where(
        light < 1, light, np.minimum(1, dark + cv2.distanceTransform((light == 1).astype(np.uint8), 2, 5) / width)
    )


@pytest.mark.parametrize("noise", [0.0, 1.5])
def test_what_fades_into_the_ground_is_no_part_of_a_vehicle(noise):
    labels, light = picture(around(0.1, 70.0), noise)
    left = without_soft_shadows(labels, light)
    body = np.zeros((H, W), bool)
    body[80:160, 120:200] = True
    assert np.count_nonzero(labels[~body]) > 8000
    assert np.count_nonzero(left[~body] == SHADOW) < 0.1 * np.count_nonzero(labels[~body] == SHADOW)
    assert (left[body] == FOREGROUND).all()


@pytest.mark.parametrize("dark", [0.55, 0.85])
def test_grey_paint_and_the_shadows_of_the_sun_have_an_edge(dark):
    light = np.ones((H, W))
    light[60:180, 90:230] = dark
    labels, light = picture(light, 1.0)
    left = without_soft_shadows(labels, light)
    assert np.count_nonzero(left) > 0.95 * np.count_nonzero(labels)


def test_a_hole_in_a_body_is_no_ground_that_it_fades_into():
    v, u = np.mgrid[:H, :W]
    out = np.maximum(np.abs(v - 120) / 70, np.abs(u - 160) / 100)  # 1 at the edge of a body that is as the road inside
    labels, light = picture(np.where(out < 1, 1 - np.clip(out - 0.6, 0, None), 1.0))
    assert np.count_nonzero((labels == 0) & (out < 1)) > 1000
    left = without_soft_shadows(labels, light)
    assert np.count_nonzero(left) > 0.95 * np.count_nonzero(labels)


def beside(shadow, paint):
    """A vehicle of `paint` with the shadow that it casts, and its outline."""
    light = np.ones((H, W))
    light[150:190, 120:260] = shadow
    light[90:170, 100:200] = paint
    return light, np.array([[100, 90], [199, 90], [199, 169], [100, 169]])


def learnt(shadow, frames=40):
    darkness = Darkness()
    light, outline = beside(shadow, 0.48)
    for _ in range(frames):
        darkness.learn(*picture(light, 1.0), [outline])
    return darkness


@pytest.mark.parametrize("paint", [0.46, 0.7, 0.9])
def test_paint_that_is_not_as_dark_as_the_shadows_is_none(paint):
    darkness = learnt(0.57)
    assert darkness.known
    labels, light = picture(beside(0.57, paint)[0], 1.0)
    told = darkness.told(labels, light)
    assert np.mean(told[92:168, 102:198] == FOREGROUND) > 0.95
    assert np.mean(told[172:188, 122:258] == SHADOW) > 0.95
    rim = np.count_nonzero(told[148:192, 202:262] == FOREGROUND)
    assert rim < 0.05 * 40 * 60


def test_nothing_is_told_where_the_sun_does_not_shine():
    darkness = learnt(0.85)
    assert not darkness.known
    labels, light = picture(beside(0.85, 0.48)[0])
    assert darkness.told(labels, light) is labels


def test_what_is_followed_tells_nothing_of_shadows():
    darkness, light = Darkness(), np.ones((H, W))
    light[90:170, 100:200] = 0.5
    for _ in range(40):
        darkness.learn(*picture(light), [np.array([[99, 89], [200, 89], [200, 170], [99, 170]])])
    assert not darkness.known


def test_lightness_is_the_share_of_the_empty_scene():
    light = lightness(np.full((4, 4), 40, np.uint8), np.full((4, 4), 80, np.uint8))
    assert (light == LIT / 2).all()
