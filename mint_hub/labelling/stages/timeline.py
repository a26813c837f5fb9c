"""The time line of a video: frames at a constant rate, on which all its clips have their place.

Frame n of the time line is shown at ``start_s + n / fps``. A clip's source times are those of the
stored frames nearest to its places, so each may be half a stored frame off; a clip as a whole is
not.

>>> from pathlib import Path
>>> clip = Clip("a", Path("a.mp4"), 0, (384, 384), 30.0, np.arange(3, 6) / 30)
>>> place(clip, start_s=0.0)
3
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mint_hub.labelling.records import Clip


def place(clip: Clip, start_s: float) -> int:
    """Frame of the time line, which begins at ``start_s``, that is the clip's first."""
    own = np.arange(clip.num_frames)
    return round(float(np.median((clip.source_timestamps_s - start_s) * clip.fps - own)))


def source_times(
    clips: Sequence[Clip], places: Sequence[int], frames: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Source time (frames,) of each frame of the time line, and which ones a clip covers.

    Where clips overlap the earlier one tells; frames that no clip covers are NaN.
    """
    times = np.full(frames, np.nan)
    for clip, first in reversed(list(zip(clips, places, strict=True))):
        times[first : first + clip.num_frames] = clip.source_timestamps_s
    return times, np.isfinite(times)
