"""`pipeline("egocentric-hands")` as its users call it."""

import io

import numpy as np
import pytest
import torch
from transformers import pipeline

import mint_hub
from mint_hub.geometry import rigid
from mint_hub.geometry.hand_state import keep_in_picture
from mint_hub.loaders.schema import Episode
from tests import video_files
from tests.small_model import small_model

FRAMES = 75


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return video_files.video(tmp_path_factory.mktemp("clips") / "My Clip.mp4", FRAMES)


@pytest.fixture(scope="module")
def pipe():
    return pipeline("egocentric-hands", model=small_model(window=32))


@pytest.fixture(scope="module")
def episode(pipe, clip):
    return pipe(str(clip))


def same(a: Episode, b: Episode) -> bool:
    one, two = a.to_dict(), b.to_dict()
    arrays = [k for k, v in one.items() if isinstance(v, np.ndarray)]
    return all(np.allclose(one[k], two[k], atol=1e-5) for k in arrays)


def test_episode_is_complete(episode):
    assert isinstance(episode, mint_hub.Episode)
    assert episode.num_frames == FRAMES
    assert episode.key == "my_clip"
    np.testing.assert_allclose(episode.timestamps_s, np.arange(FRAMES) / 30, atol=1e-6)
    np.testing.assert_allclose(episode.T_camera_from_world[0], np.eye(4), atol=1e-9)
    assert episode.K.shape == (FRAMES, 3, 3)
    assert episode.joints_camera().shape == (FRAMES, 2, 21, 3)
    assert episode.joints_world().shape == (FRAMES, 2, 21, 3)
    assert episode.wrist_world().shape == (FRAMES, 2, 4, 4)
    assert episode.presence_score.shape == (FRAMES, 2)
    provenance = episode.meta["provenance"]
    assert provenance["mint_hub"] == mint_hub.__version__
    assert provenance["settings"]["overlap"] == 8
    assert episode.meta["hand_model"] == "mint-hand-template-1"
    assert len(episode.meta["source_timestamps_s"]) == FRAMES


def test_absent_hands_are_marked_not_invented(episode):
    absent = ~episode.presence
    assert absent.any()
    assert episode.presence.any()
    assert np.isnan(episode.joints_camera()[absent]).all()
    assert (episode.hand_state[absent][:, :3] == 0).all()
    np.testing.assert_array_equal(episode.presence, episode.presence_score >= 0.5)


def test_world_is_camera_composed_with_the_path(episode):
    world = episode.joints_world()[episode.presence]
    T = np.repeat(episode.T_camera_from_world[:, None], 2, 1)[episode.presence]
    camera = rigid.transform_points(T, world)
    np.testing.assert_allclose(camera, episode.joints_camera()[episode.presence], atol=1e-5)


def test_threshold_decides_presence(pipe, clip, episode):
    assert not pipe(str(clip), presence_threshold=1e3).presence.any()
    assert pipe(str(clip), presence_threshold=-1e3).presence.all()


def test_saves_and_loads(episode, tmp_path):
    loaded = Episode.load(episode.save(tmp_path / "x.npz"))
    assert loaded.allclose(episode)
    assert loaded.to_dict()["meta"] == episode.meta


def test_every_form_of_one_video(pipe, clip, episode):
    data = clip.read_bytes()
    for video in (clip, data, io.BytesIO(data), {"video": str(clip)}, {"video": {"bytes": data}}):
        assert same(pipe(video), episode)


def test_frames_in_memory(pipe, clip, episode):
    from mint_hub.loaders.video import iter_frames

    frames = np.stack([f.image for f in iter_frames(clip)])
    tensor = torch.from_numpy(frames).permute(0, 3, 1, 2)
    for video in (frames, list(frames), tensor, frames / np.float32(255)):
        assert same(pipe(video), episode)


def test_lists_generators_and_datasets(pipe, clip, episode):
    several = pipe([str(clip), clip])
    assert [same(e, episode) for e in several] == [True, True]
    lazily = pipe(path for path in [str(clip)])
    assert same(next(iter(lazily)), episode)
    import datasets

    table = datasets.Dataset.from_dict({"video": [str(clip)], "label": [3]})
    (from_table,) = list(pipe(table))
    assert same(from_table, episode)
    assert pipe([]) == []


def test_batch_size_counts_windows_and_changes_nothing(pipe, clip, episode):
    batched = pipe(str(clip), batch_size=3)
    assert batched.meta["provenance"]["settings"]["batch_size"] == 3
    assert same(batched, episode)


def test_several_devices(clip, episode):
    spread = pipeline(
        "egocentric-hands", model=small_model(window=32), devices=["cpu", "cpu"], batch_size=2
    )
    assert same(spread(str(clip)), episode)


def test_smoothing_and_settings_are_recorded(pipe, clip, episode):
    smooth = pipe(str(clip), smooth=True, presence_threshold=-1e3)
    rough = pipe(str(clip), presence_threshold=-1e3)
    jitter = [np.abs(np.diff(e.hand_state[..., :3], 2, axis=0)).mean() for e in (smooth, rough)]
    assert jitter[0] < jitter[1]
    assert smooth.meta["provenance"]["settings"]["smooth"]["q"] == 0.6


def test_a_lens_that_does_not_zoom_has_one_field_of_view(pipe, clip, episode):
    """The median of the frames' own, which differ; hands are where they were in the picture."""
    each = pipe(clip, fixed_lens=False)
    assert np.ptp(each.fov_vh_rad, axis=0).min() > 0
    one = np.median(each.fov_vh_rad, axis=0)
    np.testing.assert_allclose(episode.fov_vh_rad, np.tile(one, (episode.num_frames, 1)), rtol=1e-6)
    expected = keep_in_picture(each.hand_state, each.fov_vh_rad, episode.fov_vh_rad)
    assert not np.array_equal(each.hand_state, episode.hand_state)
    np.testing.assert_allclose(episode.hand_state, expected, rtol=1e-4, atol=1e-6)
    assert each.meta["provenance"]["settings"]["fixed_lens"] is False


def test_known_camera_is_explicit_in_the_result(pipe, clip, episode):
    height, width = episode.image_size_hw
    K = [[300, 0, width / 2], [0, 310, height / 2], [0, 0, 1]]
    known = pipe(str(clip), camera=K)
    np.testing.assert_allclose(known.K[5], K, rtol=1e-5)
    assert known.meta["provenance"]["corrections"] == ["hands placed under the given focal length"]
    assert "lens" not in known.meta
    lens = {"model": "kannala_brandt", "f": 300, "distortion": [0.1, 0, 0, 0]}
    rectified = pipe(str(clip), camera=lens)
    assert rectified.meta["lens"]["model"] == "kannala_brandt"
    assert rectified.meta["provenance"]["corrections"][0] == "frames rectified by the given lens"


def test_a_known_lens_refines_the_path(clip):
    """It is told to every window, and the result says so; the network's own lens does not."""
    sizes = {"image_size": (56, 56), "patch_size": 8, "window": 16}
    model = small_model(motion_radius=2, camera_refinement="pictures", **sizes)
    pipe = pipeline("egocentric-hands", model=model)
    free = pipe(str(clip))
    own, wide = (pipe(str(clip), camera=K) for K in (free.K[0], free.K[0] * [[0.5], [0.5], [1]]))
    said = ["hands placed under the given focal length"]
    said += ["camera path refined under the given focal length"]
    assert own.meta["provenance"]["corrections"] == said
    turns = [e.T_camera_from_world[:, :3, :3] for e in (own, wide)]
    assert np.abs(turns[0] - turns[1]).max() > 1e-4
    np.testing.assert_array_equal(own.presence, free.presence)


def test_known_poses_replace_the_camera(pipe, clip, episode):
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 2, 3] = np.linspace(0, 1, FRAMES)
    known = pipe(str(clip), camera_poses=poses)
    np.testing.assert_array_equal(known.T_camera_from_world, poses)
    np.testing.assert_array_equal(known.hand_state, episode.hand_state)


def test_native_timing(pipe, clip):
    assert pipe(str(clip), fps=None).num_frames == FRAMES
    assert pipe(str(clip), fps=10).num_frames == FRAMES // 3


def test_saved_pipeline_loads(pipe, clip, episode, tmp_path):
    pipe.save_pretrained(tmp_path)
    assert same(pipeline("egocentric-hands", model=str(tmp_path))(str(clip)), episode)


def test_rows_of_a_dataset(pipe, clip, episode):
    """A column named as in the corpus, undecoded cells, and columns that mean something else."""
    import datasets

    cell = {"path": str(clip), "bytes": clip.read_bytes()}
    rows = {"mp4": [cell], "camera": ["aria"], "__key__": ["Clip 01.mp4"], "label": [3]}
    (result,) = list(pipe(datasets.Dataset.from_dict(rows)))
    assert same(result, episode)
    assert result.key == "clip_01"
    assert result.meta["source"] == str(clip)
    with pytest.raises(ValueError, match=r"column 'video' or 'mp4', got \['label'\]"):
        list(pipe(datasets.Dataset.from_dict({"label": [3]})))


def test_misspelled_items_are_refused(pipe, clip):
    with pytest.raises(ValueError, match="camra"):
        pipe({"video": str(clip), "camra": np.eye(3)})


def test_absent_devices_are_refused_by_name():
    with pytest.raises(ValueError, match=r"device: expected one of \[.*'cpu'\], got 'cuda:9'"):
        pipeline("egocentric-hands", model=small_model(), devices=["cpu", "cuda:9"])


def test_unknown_argument(pipe, clip):
    with pytest.raises(TypeError, match="smoothing"):
        pipe(str(clip), smoothing=True)


def test_wrong_frames(pipe):
    with pytest.raises(ValueError, match=r"\(T, H, W, 3\)"):
        pipe(np.zeros((4, 8, 8, 2), np.uint8))
    for wrong in (np.zeros((9, 30, 40), np.uint8), np.full((4, 8, 8, 3), 300, np.uint16)):
        with pytest.raises(ValueError, match="expected"):
            pipe(wrong)
    with pytest.raises(ValueError, match=r"in \[0, 1\]"):
        pipe(np.full((4, 8, 8, 3), 7.0, np.float32))


def test_mismatched_processor():
    processor = mint_hub.MintProcessor.for_config(small_model().config)
    with pytest.raises(ValueError, match="image_size"):
        pipeline("egocentric-hands", model=small_model(image_size=(42, 42)), processor=processor)
