"""Pictures of what was labelled: an overlay, a plot and a page for every episode."""

import json
from collections.abc import Iterator
from pathlib import Path

from mint_hub.labelling.label import FOLDER
from mint_hub.loaders.beside import ACCOUNT
from mint_hub.loaders.schema import Episode
from mint_hub.view.overlay import write_overlay
from mint_hub.view.plots import write_trajectory_plot
from mint_hub.view.summary import write_summary


def write_reviews(corpus: Path) -> Iterator[Path]:
    """Write ``labelling/review/KEY/`` for each episode that has none yet; yield their pages.

    Args:
        corpus: folder that `label_videos` wrote.

    Raises:
        VideoError: a source video is gone or unreadable.

    """
    for account in sorted((corpus / FOLDER).glob(f"videos/*/{ACCOUNT}")):
        said = json.loads(account.read_text())
        for key in said["episodes"]:
            target = corpus / FOLDER / "review" / key
            page = target / "episode.html"
            path = account.parent / "episodes" / f"{key}.npz"
            if page.exists() or not path.exists():  # made before, or withdrawn
                continue
            episode = Episode.load(path)
            target.mkdir(parents=True, exist_ok=True)
            overlay = write_overlay(episode, said["file"], target / "episode.mp4")
            write_trajectory_plot(episode, target / "episode.png")
            write_summary(episode, page, video=said["file"], overlay=overlay)
            yield page
