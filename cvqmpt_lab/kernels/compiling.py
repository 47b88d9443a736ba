"""How kernels are compiled: one decorator for the hot path, one for the loops that call it.

`kernel` functions do not allocate, so numba's reference counting is switched off in them: it would
cost more than their arithmetic (residual and Jacobian of a region: 3.7 us with it, 0.7 us without).
`inlined` ones are merged into their
caller: a bundle of arrays is passed as some hundred scalars, which a call in the hot path cannot
afford. `driver` functions may allocate. All are cached on disk and treat division as IEEE does.
"""

from numba import njit

kernel = njit(cache=True, error_model="numpy", _nrt=False)
inlined = njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)
driver = njit(cache=True, error_model="numpy")
