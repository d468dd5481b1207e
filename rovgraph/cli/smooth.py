"""``rovgraph smooth``."""


def smooth() -> None:
    """To be written."""
    raise NotImplementedError
