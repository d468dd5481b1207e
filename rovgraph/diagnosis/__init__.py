"""Finds what is wrong with a log (`check`) and with a dive: statistics, alarms and the verdict.

May import `rovgraph.simulate`, `inference`, `problem`, `rules`, `log`, `sensors`, `model`, `kernels` and what is below.
Begin with `rovgraph.rules`, the one table of limits, and `statistics`, which lists what is computed of a dive
(docs/alarms.md). `unstated_noise` finds noise and constants that explain a dive better than its configuration. `check`
needs nothing of what judges a dive.
"""
