"""What the user knows of the camera."""

from pathlib import Path

import numpy as np
import pytest

from mint_hub.labelling.records import Video
from mint_hub.labelling.stages.given_intrinsics import GivenIntrinsics, GivenIntrinsicsSettings
from tests.labelling import sfm_scenes as scenes


def labelled(tmp_path: Path, settings: GivenIntrinsicsSettings) -> Video:
    return GivenIntrinsics(settings).run_video(
        scenes.video_of(scenes.clip_with_map(tmp_path), enlarged=2.0)
    )


@pytest.mark.parametrize(
    "settings",
    [
        GivenIntrinsicsSettings(fov_deg=float(np.degrees(2 * np.arctan(320 / 520)))),
        GivenIntrinsicsSettings(focal_px=520.0),
        GivenIntrinsicsSettings(lens={"K": [[520, 0, 319.5], [0, 520, 239.5], [0, 0, 1]]}),
    ],
)
def test_three_ways_to_say_one_camera(tmp_path: Path, settings: GivenIntrinsicsSettings) -> None:
    got = labelled(tmp_path, settings).clips[0].intrinsics
    assert got is not None
    want = (2 * np.arctan(240 / 520), 2 * np.arctan(320 / 520))  # vertical first
    assert got.fov_vh_rad == pytest.approx(want)
    assert (got.lens, got.source, got.confidence) == (None, "given", 1.0)


def test_what_a_centred_pinhole_does_not_say_is_kept_as_the_lens(tmp_path: Path) -> None:
    spec = {"model": "kannala_brandt", "f": 300.0, "distortion": [0.01, 0.0, 0.0, 0.0]}
    got = labelled(tmp_path, GivenIntrinsicsSettings(lens=spec)).clips[0].intrinsics
    assert got is not None
    assert got.lens is not None
    assert got.lens["model"] == "kannala_brandt"
    off = {"K": [[520, 0, 300.0], [0, 520, 239.5], [0, 0, 1]]}
    moved = labelled(tmp_path, GivenIntrinsicsSettings(lens=off)).clips[0].intrinsics
    assert moved is not None
    assert moved.lens is not None
    assert moved.lens["cx"] == 300


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        (GivenIntrinsicsSettings(), "expected one of .*, got none"),
        (GivenIntrinsicsSettings(fov_deg=90, focal_px=300), "got fov_deg, focal_px"),
        (GivenIntrinsicsSettings(fov_deg=200), "between 0 and 180, got 200"),
        (GivenIntrinsicsSettings(focal_px=-3), "positive pixels, got -3"),
    ],
)
def test_nonsense_is_refused_at_once(settings: GivenIntrinsicsSettings, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        GivenIntrinsics(settings)
