"""Pictures and replays of motions. Only the command line and the live page import this room."""

from robotdiffuse.visualization.picture import PictureSettings, write_picture
from robotdiffuse.visualization.replay_page import write_replay

__all__ = ["PictureSettings", "write_picture", "write_replay"]
