"""The command line: thin commands, each a function of the API plus printing.

May import everything; nothing imports it. Begin with `app` (`main` registers the commands); each command stands in the
module of its kind: `smooth`, `logs`, `online`, `report`, `lab`. Heavy imports sit inside the command bodies, so that
``rovgraph --help`` is instant.
"""
