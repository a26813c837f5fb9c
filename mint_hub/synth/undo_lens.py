"""The lens of a synthetic clip, undone: pictures as the pinhole of its labels would take them.

    images = undo_lens(packed_images(reader, i), reader[i])

A clip that was filmed through a lens (``mint-hub synth --lens``) keeps it in ``meta["synth"]``; all
other pictures of packed corpora are in the geometry of their labels already.
"""

from __future__ import annotations

import json
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.lenses import Lens, Rectification, rectification
from mint_hub.loaders.schema import Episode

__all__ = ["lens_of", "undo_lens"]


def lens_of(episode: Episode) -> Lens | None:
    """Return the lens that bends an episode's pictures; None where they are a pinhole's.

    Raises:
        ValueError: ``meta["synth"]["lens"]`` is no lens.

    """
    synth = episode.meta.get("synth")
    values = synth.get("lens") if isinstance(synth, dict) else None
    return None if values is None else Lens.from_dict(values)


def undo_lens(images: NDArray[np.uint8], episode: Episode) -> NDArray[np.uint8]:
    """Resample pictures (N, H, W, 3) of an episode to the camera of its labels, of the same size.

    They come back as they are where there is no lens; black is what the lens did not see.

    Raises:
        ValueError: as `lens_of`; pictures of another size than the lens's. Names the episode.

    """
    lens = lens_of(episode)
    if lens is None:
        return images
    fix = _rectification(json.dumps(lens.to_dict(), sort_keys=True))
    try:
        return np.stack([fix.apply(image) for image in images])
    except ValueError as error:
        raise ValueError(f"{error} (episode {episode.key})") from None


@lru_cache(maxsize=8)
def _rectification(lens: str) -> Rectification:
    return rectification(Lens.from_dict(json.loads(lens)))
