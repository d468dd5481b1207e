"""The entrance for Python programs: what each command does, without its printing.

Its parts are used as `rovgraph.smooth`, `rovgraph.check` and so on, which `rovgraph.__init__` imports when they are
first used; docs/api.md shows how. The commands print what these functions return.
"""
