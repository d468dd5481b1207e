"""For researchers: estimators against each other, the thesis's filters, observability, studies, calibration.

May import `rovgraph.dive`, `readers`, `diagnosis`, `simulate`, `inference` and all below them; no estimate of a dive
needs it. Begin with `compare` (any estimators on any dives) and `estimators` (all of them by name), then `thesis` (the
filters of Jönsson 2010), `observability`, `plan`, `survey` and `crosslines`, `misalignment` (the Monte Carlo study),
`calibrate` (magnetometer and noise) and `evaluate` (errors against a reference).
"""
