"""Where messages come from.

A source is a link, which yields bytes as they come, and a decoder, which makes messages of
them and knows nothing of where they came from. `opening` makes sources of URLs;
docs/online-sources.md is the contract.
"""

from rovgraph.live.sources.opening import open_source, open_sources
from rovgraph.live.sources.source import Source

__all__ = ["Source", "open_source", "open_sources"]
