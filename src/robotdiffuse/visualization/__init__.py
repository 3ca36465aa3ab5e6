"""Pictures, HTML replays and the interactive page. Of the other packages, only `cli` imports this one."""

from robotdiffuse.visualization.picture import PictureSettings, write_comparison, write_picture
from robotdiffuse.visualization.replay_page import write_problem, write_replay

__all__ = ["PictureSettings", "write_comparison", "write_picture", "write_problem", "write_replay"]
