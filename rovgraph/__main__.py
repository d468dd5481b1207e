"""``python -m rovgraph``: the command line, where its script is not on the path."""

from rovgraph.cli.app import run

if __name__ == "__main__":
    run()
