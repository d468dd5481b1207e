"""``rovgraph simulate``."""


def simulate() -> None:
    """To be written."""
    raise NotImplementedError
