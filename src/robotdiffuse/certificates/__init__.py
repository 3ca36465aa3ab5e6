"""Certificates of motions: a proof that a motion is free, and a small checker that needs no search.

The checker (`checker.py`, with `bounds.py`, `kinematics.py`, `obstacles.py` and `requests.py`) is plain NumPy
and shares no code with the validator; `writer.py` finds the proof for what the validator calls valid.
"""
