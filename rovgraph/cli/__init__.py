"""The command line: thin commands, each with a library twin.

Heavy imports sit inside the command bodies, so that ``rovgraph --help`` is instant.
"""
