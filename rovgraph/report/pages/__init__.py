"""The page of a results folder: one HTML file that opens offline and is interactive.

May import what `rovgraph.report` may; the only package that imports jinja2. Begin with `reporting` (`write_page` makes
``report.html`` from a folder alone) and `page` (a page is a list of `Section`). Each section of a dive's page is a
module; ``assets/page.js`` draws them with Plotly when they come into view. `studies` has the pages of several dives.
"""
