"""The online mode: sources in, navigation solutions out, and continued operation when a sensor fails.

May import `rovgraph.dive`, `readers`, `diagnosis`, `inference`, `problem` and all below them; not `lab`, `report` or
`web`. Begin with `session` (a run: sources to a navigator to outputs and disk), then `navigator` (a message to a
solution), `sources` and `outputs`. docs/online.md describes the use.
"""
