"""How the inner loops are compiled."""

from numba import njit

compiled = njit(cache=True, _nrt=False, error_model="numpy", boundscheck=False)
