"""Pages: what a results folder holds, as one HTML file that opens offline and answers the mouse.

`reporting.write_page` makes ``report.html`` from a folder alone; `campaign.campaign_page` sets several dives side by
side. A page is a list of `parts.Section`; ``assets/page.js`` draws them with Plotly when they come into view.
"""
