"""For researchers: estimators against each other, the thesis's filters, observability, studies, calibration.

Imports estimators and simulator; no estimate of a dive needs it. Begin with `compare` (any estimators on any dives),
`estimators` (all of them by name), `thesis` (the filters of Jönsson 2010), `observability` and `plan`, `misalignment`
(the Monte Carlo study), `calibrate` (magnetometer and noise) and `evaluate` (errors against a reference).
"""
