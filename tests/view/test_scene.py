import sys
from collections import Counter

import numpy as np
import pytest

from mint_hub.conventions import SIDES
from mint_hub.view import scene
from mint_hub.view.scene import MissingExtraError, write_rrd
from tests.episodes import make_episode


def test_without_rerun_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r'pip install "mint-hub\[viz\]"') as caught:
        write_rrd(make_episode(3), tmp_path / "x.rrd")
    assert isinstance(caught.value, ImportError)
    assert not list(tmp_path.iterdir())


def test_only_rrd_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"ends in \.rrd"):
        write_rrd(make_episode(3), tmp_path / "x.bin")


def test_a_failing_scene_leaves_what_was_there(tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    path = tmp_path / "x.rrd"
    path.write_bytes(b"before")

    def fail(*_):
        raise OSError("disk full")

    with pytest.raises(FileNotFoundError, match=r"missing\.mp4"):
        write_rrd(make_episode(3), path, video=tmp_path / "missing.mp4")
    monkeypatch.setattr(scene, "_log_scores_and_text", fail)
    with pytest.raises(OSError, match="disk full"):
        write_rrd(make_episode(3), path)
    assert path.read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == ["x.rrd"]


def test_the_recording_holds_the_episode(tmp_path):
    chunks = pytest.importorskip("rerun.chunk", reason="this rerun cannot read recordings back")
    episode = make_episode(24, seed=2)
    path = write_rrd(episode, tmp_path / "x.rrd")
    rows: Counter[str] = Counter()
    translations: list[list[float]] = []
    for chunk in chunks.RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            rows[f"{chunk.entity_path} {name}"] += chunk.num_rows
        if "Transform3D:translation" in batch.schema.names:
            translations += batch.column("Transform3D:translation").to_pylist()
    for hand, side in enumerate(SIDES):
        bones = rows[f"/world/hands/{side}/bones LineStrips3D:strips"]
        assert bones == episode.presence[:, hand].sum()
        assert rows[f"/presence/{side} Scalars:scalars"] == 24
    assert rows["/text TextLog:text"] == len(episode.text)
    positions = np.array(translations, float).reshape(-1, 3)
    np.testing.assert_allclose(positions, episode.T_world_from_camera[:, :3, 3], atol=1e-6)
