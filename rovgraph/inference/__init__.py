"""Solvers of a `Problem`, and the estimates that they return.

`filter` goes through a problem a keyframe at a time, `chain` solves all of it, `graph` does so with GTSAM (batch,
places, iSAM2; the only package that imports gtsam). May import `rovgraph.problem`, `rules`, `log`, `sensors`, `model`,
`kernels` and what is below.

Begin with `smoother` (a whole dive) and `error_state` (the filter over one), then `gauss_newton` and `chain`; they
return what `estimate` and `trajectory` define.
"""
