"""The adaptive background: the empty picture, shadows, what is followed, and ghosts."""

import cv2
import numpy as np
import pytest

from visfuse_cli.vision.background import FOREGROUND, SHADOW, STILL_S, Background
from visfuse_cli.vision.empty import empty_picture
from visfuse_cli.vision.ghosts import find_ghosts

HIGH, WIDE = 120, 160


def road(seed=0):
    rng = np.random.default_rng(seed)
    coarse = rng.integers(95, 135, (12, 16, 1)).astype(np.uint8)
    return np.repeat(cv2.resize(coarse, (WIDE, HIGH), interpolation=cv2.INTER_CUBIC)[..., None], 3, axis=2)


def noisy(picture, rng, sigma=2.0):
    return np.clip(picture + rng.normal(0, sigma, picture.shape), 0, 255).round().astype(np.uint8)


def with_car(picture, left, colour=(40, 40, 200), top=50, size=(40, 30), window=True):
    picture = picture.copy()
    cv2.rectangle(picture, (left, top), (left + size[0] - 1, top + size[1] - 1), colour, -1)
    if window:
        cv2.rectangle(picture, (left + 6, top + 4), (left + size[0] - 8, top + 12), (30, 30, 30), -1)
    return picture


@pytest.fixture(params=["mog2", "knn", "kalman"])
def background(request):
    model = Background(request.param, 16.0, 0.45, 60.0)
    model.start(road())
    return model


@pytest.mark.parametrize("covered", [0.3, 0.6])
def test_the_road_is_found_under_traffic_that_covers_it_mostly(covered):
    rng = np.random.default_rng(3)
    pictures = []
    for _ in range(40):
        picture = noisy(road(), rng)
        if rng.uniform() < covered:
            colour = tuple(int(c) for c in rng.integers(0, 255, 3))
            picture = with_car(picture, 30, colour, size=(60, 40), window=False)
        pictures.append(picture)
    found = empty_picture(pictures)
    assert np.abs(found.astype(int) - road()).max() <= 8


def test_a_shadow_that_lies_there_most_of_the_time_is_no_part_of_the_scene():
    rng = np.random.default_rng(4)
    pictures = []
    for k in range(40):
        picture = road()
        if k > 12:
            picture[30:90, 40:120] = (picture[30:90, 40:120] * 0.55).astype(np.uint8)
        pictures.append(noisy(picture, rng))
    found = empty_picture(pictures)
    assert np.mean(np.abs(found.astype(int) - road()) > 8) < 0.02


def test_one_picture_is_its_own_background():
    np.testing.assert_array_equal(empty_picture([road()]), road())


def test_a_car_is_foreground_and_a_darker_road_is_shadow(background):
    picture = with_car(road(), 20)
    picture[90:110, 100:150] = (picture[90:110, 100:150] * 0.65).astype(np.uint8)
    labels = background.detect(noisy(picture, np.random.default_rng(1)))
    assert (labels[52:78, 22:58] == FOREGROUND).mean() > 0.9
    assert (labels[92:108, 102:148] == SHADOW).mean() > 0.8
    assert (labels[:40] == 0).mean() > 0.97


def test_looking_changes_nothing(background):
    picture = with_car(road(), 20)
    first = background.detect(picture).copy()
    for _ in range(50):
        last = background.detect(picture)
    np.testing.assert_array_equal(first, last)


@pytest.mark.parametrize("followed", [True, False])
@pytest.mark.parametrize("model", ["mog2", "kalman"])
def test_what_is_followed_never_dissolves_and_what_stands_joins(model, followed):
    rng = np.random.default_rng(5)
    background = Background(model, 16.0, 0.45, 60.0)
    background.start(road())
    outline = np.array([[16.0, 46], [64, 46], [64, 84], [16, 84]])
    for k in range(600):
        picture = noisy(with_car(road(), 20), rng)
        labels = background.detect(picture)
        background.learn(picture, k / 10, [outline] if followed else [])
    still_there = (labels[52:78, 22:58] == FOREGROUND).mean()
    assert (still_there > 0.9) if followed else (still_there < 0.2)


def test_a_thing_that_has_gone_leaves_no_ghost_and_a_thing_that_stands_stays(background):
    rng = np.random.default_rng(2)
    background.start(with_car(road(), 100))  # stood there while the scene was learnt
    labels = np.zeros(0)
    for k in range(int(25 * (STILL_S + 1))):
        picture = noisy(with_car(road(), 20), rng)  # another has come to stand elsewhere
        labels = background.detect(picture)
        background.learn(picture, k / 25, [])
    assert (labels[52:78, 102:138] == FOREGROUND).mean() < 0.05
    assert (labels[52:78, 22:58] == FOREGROUND).mean() > 0.9


def test_a_part_of_a_large_thing_of_one_colour_is_no_ghost():
    grey = cv2.cvtColor(road(), cv2.COLOR_BGR2GRAY)
    lorry = cv2.rectangle(grey.copy(), (20, 20), (140, 100), 60, -1)
    stood = cv2.rectangle(np.zeros_like(grey), (60, 40), (100, 80), 255, -1)  # its middle looks alike wherever it is
    bright = cv2.rectangle(grey.copy(), (60, 40), (100, 80), 200, -1)
    assert not find_ghosts(lorry, lorry, stood, cv2.compare(lorry, grey, cv2.CMP_NE), bright).any()
    assert find_ghosts(lorry, lorry, stood, stood, bright)[60, 80] == 255  # by itself it would be one


def test_the_picture_follows_what_changes_by_little_and_forgets_a_shadow_that_passed():
    background = Background("mog2", 16.0, 0.45, 2.0)
    background.start(road())
    shaded = (road() * 0.6).astype(np.uint8)
    lit = road() + np.uint8(4)
    for k in range(600):
        picture = shaded if k < 300 and k % 25 < 3 else lit
        background.detect(picture)
        background.learn(picture, k / 25, [])
        if k == 299:
            assert np.abs(background.picture - lit.astype(float)).mean() < 8  # a tenth of the time 45 levels darker
    assert np.abs(background.picture - lit.astype(float)).max() <= 1


def test_ghosts_need_contrast_in_the_background_alone():
    grey = cv2.cvtColor(road(), cv2.COLOR_BGR2GRAY)
    car = cv2.cvtColor(with_car(road(), 60), cv2.COLOR_BGR2GRAY)
    moved = cv2.compare(cv2.absdiff(grey, car), 10, cv2.CMP_GT)
    assert find_ghosts(grey, grey, moved, moved, car)[65, 80] == 255
    assert not find_ghosts(car, car, moved, moved, grey).any()
    assert not find_ghosts(grey, car, moved, moved, car).any()  # it has only just gone
    nothing = np.zeros_like(grey)
    assert not find_ghosts(grey, grey, nothing, nothing, grey).any()


def test_the_kalman_background_learns_the_noise_and_the_slow_change_of_light():
    rng = np.random.default_rng(6)
    background = Background("kalman", 16.0, 0.45, 20.0)
    background.start(road())
    brighter, share = road(), []
    for k in range(0, 1500, 5):
        brighter = np.clip(road() * (1 + k / 15000), 0, 255)  # a tenth more light within a minute
        labels = background.detect(noisy(brighter, rng, 3.0))
        share.append((labels > 0).mean())
        background.learn(noisy(brighter, rng, 3.0), k / 25, [])
    assert max(share[40:]) < 0.01
    picture = with_car(brighter.astype(np.uint8), 20)
    assert (background.detect(noisy(picture, rng, 3.0))[52:78, 22:58] == FOREGROUND).mean() > 0.9
