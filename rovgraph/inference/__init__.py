"""Solvers of a `Problem`, and the estimates that come of them.

`filter` goes through a problem a keyframe at a time, `chain` solves all of it, `graph` does so with GTSAM (batch,
places, iSAM2; the only package that imports gtsam). Imports `rovgraph.problem` and what is below. Begin with `smoother`
(a whole dive) and `error_state` (the filter over one), then `gauss_newton` and `chain`; `estimate` and `trajectory`
are what they return.
"""
