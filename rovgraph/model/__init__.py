"""What an estimator assumes: the state, the table of calibration variables, the configuration, hydrodynamics.

May import `rovgraph.kernels`, `dates`, `geometry`, `errors` and `process`. Begin with `state` (what is estimated of one
epoch), `calibration` (the one table of calibration variables) and `config` (`Config`, how it is read and written; its
sections are in `config_sections`).
"""
