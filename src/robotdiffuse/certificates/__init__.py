"""Certificates: proofs that motions are valid, and a small independent checker that needs no search.

The checker (`checker.py` with `bounds.py`, `kinematics.py`, `requirements.py` and `proof.py`) is plain NumPy
and shares little more than data types with the validator. `search.py` finds a proof for a motion that the
validator accepts.
"""
