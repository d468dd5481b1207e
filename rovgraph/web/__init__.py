"""The live page: solutions to browsers, Cockpit and Prometheus, and what a person says back; docs/live-page.md.

`page.LivePage` is the entrance. The estimator's thread only puts solutions into a queue; everything else happens in a
thread of the server's own.
"""
