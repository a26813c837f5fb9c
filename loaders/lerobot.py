"""LeRobot v3, both ways: ``from_lerobot`` reads Episodes, ``to_lerobot`` writes a root.

``LeRobotSlices`` gives the same Episodes to ``write_corpus``, whose processes then read as well.
The dialects are declared in ``lerobot_columns``; ``lerobot_codec`` turns their columns into arrays.
"""

from mint_hub.loaders.lerobot_columns import Dialect, LeRobotError
from mint_hub.loaders.lerobot_read import (
    SCALE_STATUS,
    from_lerobot,
    lerobot_episodes,
    lerobot_roots,
)
from mint_hub.loaders.lerobot_slices import LeRobotSlices
from mint_hub.loaders.lerobot_write import LeRobotReport, to_lerobot

__all__ = [
    "SCALE_STATUS",
    "Dialect",
    "LeRobotError",
    "LeRobotReport",
    "LeRobotSlices",
    "from_lerobot",
    "lerobot_episodes",
    "lerobot_roots",
    "to_lerobot",
]
