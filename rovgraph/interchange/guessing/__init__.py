"""A mapping of the columns of anyone's table, proposed by names, ranges and physics (docs/formats.md)."""
