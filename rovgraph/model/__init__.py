"""What an estimator believes: the state, the table of calibration variables, the configuration, hydrodynamics.

Imports `rovgraph.kernels` and what is below. Begin with `state` (what is estimated of one epoch), `calibration` (the
one table of calibration variables) and `config` (`Config`, how it is read and written; its sections are in
`config_sections`).
"""
