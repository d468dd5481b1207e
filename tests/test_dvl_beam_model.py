"""Beams of a DVL as measurements: one equation, and every engine takes them alike."""
