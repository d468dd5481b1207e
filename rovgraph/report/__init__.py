"""The results folder: its files, figures and page, exports, and tables for a terminal.

May import `rovgraph.live`, `lab`, `dive`, `readers` and all below them; not `web`. Only modules of this package import
matplotlib, and only those that draw. Begin with `results` (the files of a folder) and `folder` (how it is written),
then `figures`, `pages` (the page), `export` (formats for other programs) and `tables`.
"""
