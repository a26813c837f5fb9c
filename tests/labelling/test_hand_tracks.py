"""From detections to one left and one right hand a frame."""

import numpy as np
import pytest

from mint_hub.conventions import LEFT, RIGHT
from mint_hub.labelling.records import Detections
from mint_hub.labelling.stages.hand_tracks import TrackSettings, hand_tracks

T = 90
SIZE = 80.0
FINGERS = np.random.default_rng(0).uniform(-0.35, 0.35, (21, 2)) * SIZE


def path(start, stop, frames=range(T)):
    """Centres of a hand that goes straight from start to stop: {frame: (x, y)}."""
    start, stop = np.array(start, float), np.array(stop, float)
    return {f: start + (stop - start) * f / (T - 1) for f in frames}


def detect(paths, rights, noise=0.0, seed=0, score=0.9, jitter=1.0):
    """Detections of hands along paths; ``rights`` says which are right ones.

    With ``noise``, that share of labels is the wrong side's. Returns them and whose each is.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for frame in range(T):
        for who in rng.permutation(len(paths)):
            if frame in paths[who]:
                rows.append((frame, who, rng.random() < noise))
    frame, who, wrong = (np.array(x) for x in zip(*rows, strict=True))
    centre = np.array([paths[w][f] for f, w, _ in rows])
    mark = centre[:, None] + FINGERS + rng.normal(0, jitter, (len(rows), 21, 2))
    half = SIZE / 2**1.5
    right = np.array(rights)[who] ^ wrong
    return Detections(
        frame=frame.astype(np.int32),
        box_xyxy=np.concatenate([centre - half, centre + half], -1).astype(np.float32),
        score=np.broadcast_to(np.float32(score), (len(rows),)) * np.ones(len(rows), np.float32),
        right_score=np.where(right, 0.95, 0.05).astype(np.float32),
        landmarks_uv=mark.astype(np.float32),
        landmarks_m=np.zeros((len(rows), 21, 3), np.float32),
    ), who


def holders(result, who):
    """Who is in each frame's left and right place, (T, 2); -1 where nobody is."""
    return np.where(result.index >= 0, who[result.index], -1)


LEFT_PATH, RIGHT_PATH = path((100, 200), (140, 240)), path((300, 220), (260, 200))


class TestTwoHands:
    @pytest.mark.parametrize("noise", [0.0, 0.2])
    def test_keep_their_sides(self, noise):
        found, who = detect([LEFT_PATH, RIGHT_PATH], [False, True], noise)
        result = hand_tracks(found, T)
        assert (holders(result, who) == [0, 1]).all()
        assert [t.side for t in result.tracks].count(LEFT) == 1
        wrong = int(((found.right_score > 0.5) != (who == 1)).sum())
        assert result.flips == wrong
        assert (wrong > 20) == (noise > 0)
        assert result.dropped == 0

    @pytest.mark.parametrize("seed", range(5))
    def test_that_cross_keep_them_with_a_fifth_of_labels_wrong(self, seed):
        """Arms cross in the middle of the clip, one hand a little below the other."""
        paths = [path((100, 200), (340, 200)), path((340, 245), (100, 245))]
        found, who = detect(paths, [False, True], 0.2, seed)
        result = hand_tracks(found, T)
        held = holders(result, who)
        assert (held == [0, 1]).mean() > 0.97
        assert len(result.tracks) == 2

    def test_confused_where_one_was_unseen_are_told_apart_again(self):
        """The left one goes, and the right one comes where it was, five frames later."""
        left = path((100, 200), (220, 200), range(45))
        right = dict.fromkeys(range(50, T), left[44])
        found, who = detect([left, right], [False, True], 0.1)
        settled = TrackSettings(side_cost=0.0)
        held = holders(hand_tracks(found, T, settled), who)
        assert (held[:45] == [0, -1]).all()
        assert (held[50:] == [-1, 1]).all()
        never = hand_tracks(found, T, TrackSettings(side_cost=0.0, swap_evidence=np.inf))
        assert len(never.tracks) == 1

    def test_named_alike_are_one_of_each(self):
        """Both are called right throughout: the leftmost is the left one."""
        found, who = detect([LEFT_PATH, RIGHT_PATH], [True, True])
        result = hand_tracks(found, T)
        assert (holders(result, who) == [0, 1]).all()


class TestOneHand:
    def test_alone_is_what_it_is_called_wherever_it_is(self):
        for right in (False, True):
            found, _ = detect([RIGHT_PATH], [right], 0.2)
            result = hand_tracks(found, T)
            side = RIGHT if right else LEFT
            assert (result.index[:, side] >= 0).all()
            assert (result.index[:, 1 - side] == -1).all()

    def test_unseen_for_a_while_stays_itself_and_unseen(self):
        """The side is decided over the gap, where few labels after it would say otherwise."""
        seen = [f for f in range(T) if not 40 <= f < 50]
        found, _ = detect([path((200, 200), (220, 200), seen)], [True])
        found.right_score[found.frame >= 85] = 0.05
        result = hand_tracks(found, T)
        assert len(result.tracks) == 1
        assert (result.index[:, RIGHT] >= 0).tolist() == [f in seen for f in range(T)]
        assert result.flips == 5

    def test_unseen_for_long_is_judged_anew(self):
        found, _ = detect([path((200, 200), (220, 200), [*range(30), *range(60, T)])], [True])
        found.right_score[found.frame >= 60] = 0.05
        result = hand_tracks(found, T)
        assert (result.index[:30, RIGHT] >= 0).all()
        assert (result.index[60:, LEFT] >= 0).all()


class TestThirdHand:
    def test_gives_way(self):
        """Somebody else's hand, seen less surely and for less long, right of both."""
        third = path((430, 100), (430, 120), range(20, 50))
        found, who = detect([LEFT_PATH, RIGHT_PATH, third], [False, True, True], 0.1)
        found.score[who == 2] = 0.5
        result = hand_tracks(found, T)
        assert (holders(result, who) == [0, 1]).all()
        assert result.dropped == 30

    def test_does_not_take_a_place_that_is_free_for_a_moment(self):
        gone = {f: p for f, p in RIGHT_PATH.items() if not 30 <= f < 36}
        third = path((430, 100), (430, 120), range(20, 50))
        found, who = detect([LEFT_PATH, gone, third], [False, True, True])
        held = holders(hand_tracks(found, T), who)
        assert (held[30:36, RIGHT] == -1).all()
        assert not (held == 2).any()

    def test_of_a_moment_is_nobodys(self):
        blink = path((250, 50), (250, 50), [10, 11])
        found, who = detect([LEFT_PATH, blink], [False, True])
        result = hand_tracks(found, T)
        assert not (holders(result, who) == 1).any()
        assert result.dropped == 2


class TestTracksOf:
    def test_no_detections_are_none(self):
        empty = Detections(
            np.zeros(0, np.int32),
            np.zeros((0, 4), np.float32),
            np.zeros(0, np.float32),
            np.zeros(0, np.float32),
            np.zeros((0, 21, 2), np.float32),
            np.zeros((0, 21, 3), np.float32),
        )
        result = hand_tracks(empty, 7)
        assert result.index.tolist() == [[-1, -1]] * 7
        assert (result.tracks, result.flips, result.dropped) == ((), 0, 0)

    def test_boxes_alone_are_as_good(self):
        """A detector without landmarks, and one box without numbers."""
        found, who = detect([LEFT_PATH, RIGHT_PATH], [False, True], 0.2)
        found.landmarks_uv[:] = np.nan
        found.box_xyxy[10] = np.nan
        held = holders(hand_tracks(found, T), who)
        expected = np.tile([0, 1], (T, 1))
        expected[found.frame[10], who[10]] = -1
        assert (held == expected).all()

    def test_a_hand_has_one_detection_a_frame(self):
        found, _ = detect([LEFT_PATH, RIGHT_PATH, LEFT_PATH], [False, True, False], 0.2)
        result = hand_tracks(found, T)
        used = result.index[result.index >= 0]
        assert len(set(used.tolist())) == len(used)
        frame, side = np.nonzero(result.index >= 0)
        assert (found.frame[result.index[frame, side]] == frame).all()

    @pytest.mark.parametrize("frame", [-1, T])
    def test_frames_that_are_not_there_are_refused(self, frame):
        found, _ = detect([LEFT_PATH], [False])
        found.frame[0 if frame < 0 else -1] = frame
        with pytest.raises(ValueError, match=f"from 0 to {T - 1}, got .*{frame}"):
            hand_tracks(found, T)

    def test_frames_out_of_order_are_refused(self):
        found, _ = detect([LEFT_PATH], [False])
        found.frame[5] = 80
        with pytest.raises(ValueError, match="not in order"):
            hand_tracks(found, T)
