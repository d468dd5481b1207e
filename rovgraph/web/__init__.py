"""The live page: solutions to browsers, Cockpit and Prometheus, and a person's commands back; docs/live-page.md.

May import `rovgraph.live`, `dive`, `readers` and all below them; not `report`. Begin with `page` (`LivePage`), then
`app` (the addresses) and `view` (the data that pages show). The estimator's thread only puts solutions into a queue;
the rest happens in a thread of the server's own.
"""
