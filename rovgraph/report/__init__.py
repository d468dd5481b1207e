"""What a person reads: the results folder, its files and figures, and tables for a terminal.

Only modules of this package import matplotlib, and only those that draw.
"""
