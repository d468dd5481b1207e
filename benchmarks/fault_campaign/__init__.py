"""Dives with known faults, and what `rovgraph smooth` makes of them.

The simulator shares nothing with `rovgraph.simulate` or rovgraph's models: it has its own
frames and equations, on the rotating WGS-84 ellipsoid. Members, bottom first:

earth       ellipsoid, gravity, Earth rate
motion      a smooth motion over the ellipsoid: rate, specific force, position; a strapdown
scenarios   named motions
vehicle     what the instruments really are, and the configuration that describes them
instruments samples of every instrument; streams to a log
judge       one dive through the command, its errors in standard deviations, the outcome
cases       the table of faults
campaign    every case over many seeds
"""
