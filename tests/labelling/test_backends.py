"""The register of backends names what is there, and makes it of plain settings."""

from dataclasses import is_dataclass

import pytest

from mint_hub.labelling.backends import (
    BACKENDS,
    OPTIONAL,
    STAGES,
    backend_of,
    default_backend,
    make,
)
from mint_hub.labelling.stage import ClipStage, Resources, VideoStage
from mint_hub.labelling.stages.mediapipe_hands import MediaPipeSettings

EVERY = pytest.mark.parametrize("backend", BACKENDS, ids=lambda b: f"{b.stage}-{b.name}")


@EVERY
def test_every_backend_is_what_it_is_listed_as(backend):
    kind = backend.load()
    assert (kind.stage, kind.backend) == (backend.stage, backend.name)
    assert isinstance(kind.resources, Resources)
    assert kind.version
    settings = backend.settings_type()
    assert is_dataclass(settings)
    assert settings.__dataclass_params__.frozen
    assert hasattr(kind, "run_clip") != hasattr(kind, "run_video")
    assert kind.__doc__


def test_names_and_defaults():
    assert len({(b.stage, b.name) for b in BACKENDS}) == len(BACKENDS)
    order = [STAGES.index(b.stage) for b in BACKENDS]
    assert order == sorted(order)
    for stage in STAGES:
        defaults = [b for b in BACKENDS if b.stage == stage and b.default]
        assert len(defaults) == (stage not in OPTIONAL), stage
        assert default_backend(stage) == (defaults[0].name if defaults else None)


def test_made_of_plain_settings():
    stage = make("detect", "mediapipe", {"max_hands": 3})
    assert isinstance(stage, ClipStage)
    assert stage.settings == MediaPipeSettings(max_hands=3)
    assert make("detect", None).backend == "mediapipe"
    assert make("depth", None, {"weights": "x"}).backend == "moge2"
    scale = make("scale", None, {"known": ["1.7"]})
    assert isinstance(scale, VideoStage)
    assert scale.settings.known == ("1.7",)


def test_settings_within_settings():
    """Where a setting is a dataclass itself, a mapping makes it."""
    stage = make("clean", None, {"cleaning": {"gap_frames": 7}, "smooth": False})
    assert stage.settings.cleaning.gap_frames == 7
    assert stage.settings.cleaning.spike_frames == 15
    with pytest.raises(ValueError, match=r"clean=default\.cleaning: expected .*'gaps'"):
        make("clean", None, {"cleaning": {"gaps": 7}})


def test_what_there_is_not():
    with pytest.raises(ValueError, match=r"stage: expected one of normalise, .* got 'sleep'"):
        backend_of("sleep", "x")
    with pytest.raises(ValueError, match="stage"):
        default_backend("sleep")
    with pytest.raises(ValueError, match="backend of camera: expected one of sfm, megasam"):
        make("camera", "colmap")
    with pytest.raises(ValueError, match=r"detect=mediapipe: expected settings among height.*'x'"):
        make("detect", "mediapipe", {"x": 1})
