"""The colours of figures and pages: those of Okabe and Ito, for colour-blind readers."""

ESTIMATES = {"smoothed": "#0072B2", "filtered": "#D55E00", "dead_reckoning": "#888888", "reference": "black"}
OTHER = "#CC79A7"
USED, REJECTED, UNUSED = "#009E73", "#A3206B", "#AAAAAA"
PRIOR = "#ECE7DA"
SERIES = ("#0072B2", "#D55E00", "#009E73", "#7B3294", "#A3206B", "#333333", "#8C6D00", "#56808F")  # lines of one panel
BOTTOM = "#8C6D46"
