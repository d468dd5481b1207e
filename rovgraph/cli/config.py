"""``rovgraph config``."""


def config() -> None:
    """To be written."""
    raise NotImplementedError
