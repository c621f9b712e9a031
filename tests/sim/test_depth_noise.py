from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.sim.depth_noise import NOISE_MODELS, noise_model

SIZE = (480, 640)
FRONTAL = np.ones(SIZE, np.float32)


def flat(z: float) -> np.ndarray:
    return np.full(SIZE, z, np.float32)


def measured(name: str, depth: np.ndarray, cosine: np.ndarray = FRONTAL, seed: int = 0) -> np.ndarray:
    return NOISE_MODELS[name].apply(depth, cosine, np.random.default_rng(seed))


@pytest.mark.parametrize(("name", "at_60_cm"), [("l515", 0.001), ("d455", 0.002)])
def test_noise_has_its_published_size_and_grows_with_distance(name, at_60_cm):
    near, far = (np.std(measured(name, flat(z)) - z) for z in (0.6, 1.2))
    assert near == pytest.approx(at_60_cm, rel=0.1)
    growth = {"l515": 1.6, "d455": 4.0}[name]
    assert far / near == pytest.approx(growth, rel=0.1)


def test_stereo_noise_is_smooth_and_lidar_noise_is_not():
    correlation = {}
    for name in NOISE_MODELS:
        error = measured(name, flat(0.7)) - 0.7
        correlation[name] = np.corrcoef(error[:, :-2].ravel(), error[:, 2:].ravel())[0, 1]
    assert correlation["l515"] < 0.3 < 0.7 < correlation["d455"]


@pytest.mark.parametrize("name", NOISE_MODELS)
def test_frontal_surfaces_have_no_holes_and_grazing_ones_have(name):
    assert (measured(name, flat(0.6)) > 0).all()
    shares = [(measured(name, flat(0.6), c * FRONTAL) == 0).mean() for c in (0.5, 0.15, 0.01)]
    assert shares[0] == 0
    assert 0.1 < shares[1] < 0.95
    assert shares[2] == 1


def test_noise_grows_towards_grazing_angles():
    frontal, slanted = (np.std(measured("l515", flat(0.6), c * FRONTAL)) for c in (1.0, 0.4))
    assert slanted / frontal == pytest.approx(2.5, rel=0.1)


@pytest.mark.parametrize("name", NOISE_MODELS)
def test_edges_lose_pixels_and_only_few_fly(name):
    depth = flat(0.8)
    depth[100:300, 200:400] = 0.6
    out = measured(name, depth)
    step = ndimage.maximum_filter(depth, 3) - ndimage.minimum_filter(depth, 3) > 0.1
    assert (out[~step] > 0).all()
    assert 0.2 < (out[step] == 0).mean() < 0.5
    flying = (out > 0.62) & (out < 0.78)
    assert not flying[~step].any()
    assert 0 < flying[step].mean() < 0.15


def test_a_slanted_plane_is_no_edge():
    plane = np.broadcast_to(np.linspace(0.4, 1.5, 480, dtype=np.float32)[:, None], SIZE)
    assert (measured("l515", plane) > 0).all()


@pytest.mark.parametrize(("name", "step"), [("l515", 0.00025), ("d455", 0.001)])
def test_depth_is_in_whole_units(name, step):
    units = measured(name, flat(0.613)) / step
    assert np.abs(units - np.round(units)).max() < 1e-3


def test_missing_stays_missing_and_out_of_range_is_missing():
    depth = flat(0.6)
    depth[:50] = 0
    depth[400:] = 0.1
    out = measured("l515", depth)
    assert (out[:50] == 0).all()
    assert (out[401:] == 0).all()


@pytest.mark.parametrize("name", NOISE_MODELS)
def test_the_seed_decides(name):
    assert np.array_equal(measured(name, flat(0.6)), measured(name, flat(0.6)))
    assert not np.array_equal(measured(name, flat(0.6)), measured(name, flat(0.6), seed=1))
    assert measured(name, flat(0.6)).dtype == np.float32


def test_noise_is_as_strong_at_every_image_size():
    small = NOISE_MODELS["d455"].apply(flat(0.6)[:224, :224], FRONTAL[:224, :224], np.random.default_rng(0))
    assert np.std(small) == pytest.approx(0.002, rel=0.15)


def test_models_are_chosen_by_name():
    assert noise_model(None) is None
    assert noise_model("d455") is NOISE_MODELS["d455"]
    with pytest.raises(ConfigError, match="l515, d455, or None"):
        noise_model("kinect")


@pytest.mark.parametrize(
    ("change", "words"),
    [({"edge_dropout": 0.9}, "sum up to 1"), ({"resolution_m": -1.0}, ">= 0"), ({"range_m": (1.0, 0.5)}, "rising")],
)
def test_impossible_settings_are_refused(change, words):
    with pytest.raises(ConfigError, match=words):
        replace(NOISE_MODELS["l515"], **change)


def test_images_of_two_sizes_are_refused():
    with pytest.raises(InputError, match="one size"):
        measured("l515", flat(0.6), FRONTAL[:-1])
