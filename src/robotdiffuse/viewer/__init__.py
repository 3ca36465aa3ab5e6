"""Pictures and replays of motions. Only the command line and the live page import this room."""

from robotdiffuse.viewer.html import write_replay
from robotdiffuse.viewer.picture import PictureSettings, write_picture

__all__ = ["PictureSettings", "write_picture", "write_replay"]
