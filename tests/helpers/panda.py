"""The bundled Panda, and configurations that many tests look from or plan between."""

import numpy as np

import robotdiffuse as rd

PANDA = rd.load_robot("panda")
HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
START, GOAL = (np.array([turn, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]) for turn in (-1.0, 1.0))
LEFT, RIGHT = (np.array([turn, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]) for turn in (0.9, -0.9))
