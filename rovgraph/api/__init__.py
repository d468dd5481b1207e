"""The API for Python programs: the work of each command, without its printing.

May import `rovgraph.report`, `web`, `live`, `lab` and all below them; not `cli`. Begin with `smoothing` (`smooth`) and
`logs` (`read_log`, `check`). Its parts are used as `rovgraph.smooth`, `rovgraph.check` and so on, which
`rovgraph.__init__` imports when they are first used; docs/api.md shows how. The commands print what these functions
return.
"""
